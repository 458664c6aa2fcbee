"""Calibration on a chessboard in free poses, without plate or stage."""
