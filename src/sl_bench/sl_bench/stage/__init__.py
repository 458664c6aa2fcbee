"""Stages, emulated on pseudo-terminals: GRBL and Zaber."""
