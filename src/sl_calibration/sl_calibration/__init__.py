"""From views of a hole plate to a calibration that says how far to trust it.

Must not know: devices, ROS topics, the bench. Imports `sl_projector` and `sl_reconstruct`.
"""
