"""Hand-written passes, kernels and optimisers, compared in tests with the plain modules that they stand in for."""
