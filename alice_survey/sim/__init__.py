"""The closed loop without a vehicle: the vehicle itself, and the sea floor that it photographs."""
