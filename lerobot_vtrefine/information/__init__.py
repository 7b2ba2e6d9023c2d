"""What a task's sensors know, before any policy is trained: regressors, and an expert that acts on them."""
