"""Ways to look at a trained agent: a single episode, videos and film strips, predictions of its model."""
