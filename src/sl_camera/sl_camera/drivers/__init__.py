"""One driver for each kind of camera, and which driver an address means."""
