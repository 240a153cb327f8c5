"""A run on disk: its folder, log, checkpoints, arrays and trackers. Nothing here knows reinforcement learning."""
