"""Trained agents to look at: one episode step by step, films, predictions of the model."""
