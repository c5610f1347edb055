"""Quality of a calibration: measures, plots and the page that shows them."""
