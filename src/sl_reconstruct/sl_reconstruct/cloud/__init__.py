"""Clouds and height maps: data, refusals, files, and planes through them."""
