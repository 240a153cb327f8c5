"""The training: replay, rollout, phases, both loops, evaluation, and `train`."""
