"""What the simulation gets wrong: recordings, residuals, candidate causes, verdict and the extended model."""
