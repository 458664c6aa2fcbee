"""GRBL 1.1 and grblHAL stages."""
