"""How wrong the calibration in force is, measured on a plate or a flat."""
