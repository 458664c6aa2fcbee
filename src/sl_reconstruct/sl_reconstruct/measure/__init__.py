"""Measurements of clouds and height maps, each with its standard uncertainty.

Knows points (x, y, z, sigma; metres) and regions of the x-y plane; knows neither images nor ROS.
What an uncertainty covers: `sl_reconstruct.measure.result`.
"""
