"""Rigs, parts and images whose truth is known."""
