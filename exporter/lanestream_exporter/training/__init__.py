"""Training: recipes, data sources, the training loop, and the task of each network."""
