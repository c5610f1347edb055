"""What a calibration is worth: measures, plots and the page that shows them."""
