"""The solution: linear step, image centre, bundle adjustment, uncertainty, checks."""
