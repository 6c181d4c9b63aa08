"""Training with the RL Zoo: hyperparameter files, the run itself, and what is kept of it."""
