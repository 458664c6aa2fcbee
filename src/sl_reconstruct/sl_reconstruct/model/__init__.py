"""The rig model (Eqs. 1-4), its calibration file, and lenses of other programs."""
