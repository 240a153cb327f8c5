"""Compare the speed of SAC-MLP and SBX's SAC: updates per second of both on Pendulum, in turn, on this machine.

Both have two hidden layers of 256, batches of 256, one update per step, and Adam with a rate of 3e-4. The algorithms
differ: ours has V, its target, and separate networks for μ and log σ; SBX has two target Qs, and one network for both.
Our Pendulum is a part of the compiled program; SBX steps Gymnasium's in Python. Both times include stepping.

    python -m venv /tmp/sbx && /tmp/sbx/bin/pip install torch==2.13.0 "sbx-rl==0.28.*"
    python benchmarks/race_sbx.py /tmp/sbx/bin/python
"""

import json
import statistics
import subprocess
import sys
import time

ROUNDS, WARM, STEPS = 3, 1_500, 3_000


def ours() -> float:
    """Updates per second of beliefrl's sac-mlp."""
    import jax

    from beliefrl import agents, tasks
    from beliefrl.training import phases
    from beliefrl.training.rounds import stretch_length

    agent, task = agents.make("sac-mlp", step_start_rl=1_000), tasks.make("pendulum")
    program = phases.compile_program(agent, task, capacity=1_000_000, episodes=1)
    seeds, step = program.begin(jax.random.split(jax.random.key(0), 1)), 0
    stretch = stretch_length(agent)
    while step < agent.step_start_rl:
        seeds, _ = program.explore(seeds, step, stretch)
        step += stretch
    while step < WARM:
        seeds, _ = program.learn(seeds, step, stretch)
        step += stretch
    jax.block_until_ready(seeds)
    began = time.perf_counter()
    for _ in range(STEPS // stretch):
        seeds, _ = program.learn(seeds, step, stretch)
        step += stretch
    jax.block_until_ready(seeds)
    return STEPS / (time.perf_counter() - began)


def theirs() -> float:
    """Updates per second of SBX's SAC."""
    import jax
    from sbx import SAC

    settings = {"batch_size": 256, "learning_rate": 3e-4, "learning_starts": 1_000, "buffer_size": 1_000_000}
    model = SAC("MlpPolicy", "Pendulum-v1", train_freq=1, gradient_steps=1, seed=0, **settings)
    model.learn(WARM)
    jax.block_until_ready(model.policy.actor_state.params)
    before, began = model._n_updates, time.perf_counter()
    model.learn(STEPS, reset_num_timesteps=False)
    jax.block_until_ready(model.policy.actor_state.params)
    return (model._n_updates - before) / (time.perf_counter() - began)


def main(peer: str) -> None:
    """Measure both `ROUNDS` times in turn, each in a process of its own; print medians and the median ratio."""
    rates = {"ours": [], "theirs": []}
    for number in range(ROUNDS):
        for who, python in (("ours", sys.executable), ("theirs", peer)):
            output = subprocess.run([python, __file__, "--run", who], capture_output=True, text=True, check=True).stdout
            rates[who].append(float(output.split()[-1]))
        print(
            f"round {number + 1}: beliefrl {rates['ours'][-1]:.0f}, SBX {rates['theirs'][-1]:.0f} updates/s", flush=True
        )
    medians = {who: statistics.median(values) for who, values in rates.items()}
    ratios = [ours / theirs for ours, theirs in zip(rates["ours"], rates["theirs"], strict=True)]
    print(json.dumps({"beliefrl": medians["ours"], "sbx": medians["theirs"], "ratio": statistics.median(ratios)}))


if __name__ == "__main__":
    if len(sys.argv) == 3 and sys.argv[1] == "--run":
        print({"ours": ours, "theirs": theirs}[sys.argv[2]]())
    elif len(sys.argv) == 2 and not sys.argv[1].startswith("-"):
        main(sys.argv[1])
    else:
        sys.exit("usage: python benchmarks/race_sbx.py PYTHON_WITH_SBX")
