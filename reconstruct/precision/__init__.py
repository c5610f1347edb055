"""How well a survey will be known, predicted from its plan."""
