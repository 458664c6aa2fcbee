"""Zaber stages with the ASCII protocol."""
