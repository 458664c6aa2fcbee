"""What a stage is, and its drivers: GRBL, Zaber, and one that is moved by hand."""
