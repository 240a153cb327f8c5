"""From the first environment step to the last: replay, rollout, phases, both loops, evaluation, `train` itself."""
