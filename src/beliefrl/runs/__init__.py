"""A run on disk: its folder, log, checkpoints, arrays and trackers. It imports no reinforcement learning code."""
