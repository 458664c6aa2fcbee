"""What a calibration is solved from: taking the views, extracting them, keeping them."""
