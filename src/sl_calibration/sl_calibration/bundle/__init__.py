"""Bundle adjustment: parameters, their derivatives, robust least squares, covariance."""
