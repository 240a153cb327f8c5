"""Compare the time of a training step of VRM with that of the authors' PyTorch code, in turn, on this machine.

Both run the paper's settings at the sizes of velocities-only Hopper (6 observations, 3 actions) on noise: each step
acts once, updates the controller once and, every fifth step, the keep-learning model. The authors draw these updates
at random in that proportion; here every fifth step is one. Simulation, evaluation and pre-training are left out.

"With options" is `vrm --burn-in 16 --store-state --precision bfloat16`, which computes less, and rounds.

    git clone https://github.com/oist-cnru/Variational-Recurrent-Models /tmp/authors
    python -m venv /tmp/torch && /tmp/torch/bin/pip install torch==2.13.0 numpy
    python benchmarks/race_authors.py /tmp/authors /tmp/torch/bin/python
"""

import statistics
import subprocess
import sys
import time

OBS, ACTIONS, INTERVAL = 6, 3, 5
EPISODES, LENGTH = 20, 100  # in the replay
ROUNDS, OURS, THEIRS = 5, 300, 50  # steps timed in each round
OURS_WITH = {"vrm": {}, "with options": {"precision": "bfloat16", "burn_in": 16, "store_state": True}}


def ours(precision: str = "float32", **hyperparameters) -> float:
    """Milliseconds per step of beliefrl's vrm with these settings."""
    import jax

    from beliefrl import agents
    from beliefrl.training import phases
    from beliefrl.training.bench import Noise
    from beliefrl.training.rounds import stretch_length

    jax.config.update("jax_default_matmul_precision", precision)
    agent = agents.make("vrm", **hyperparameters)
    program = phases.compile_program(agent, Noise(OBS, ACTIONS), capacity=EPISODES * LENGTH, episodes=1)
    seeds, stretch = program.begin(jax.random.split(jax.random.key(0), 1)), stretch_length(agent)
    explored = EPISODES * LENGTH
    for step in range(0, explored, stretch):
        seeds, _ = program.explore(seeds, step, stretch)
    seeds, _ = program.learn(seeds, explored, 1)
    jax.block_until_ready(seeds)
    began = time.perf_counter()
    for _ in range(0, OURS, stretch):
        seeds, _ = program.learn(seeds, explored, stretch // agent.cycle)
    jax.block_until_ready(seeds)
    return 1e3 * (time.perf_counter() - began) / OURS


def theirs(checkout: str) -> float:
    """Milliseconds per step of the authors' code."""
    sys.path.insert(0, checkout)
    import numpy as np
    from vrdm import VRDM, VRM

    sizes = {"rnn_type": "mtlstm", "d_layers": [256], "z_layers": [64], "decode_layers": [128, 128]}
    first, keep = (
        VRM(input_size=OBS + 1, action_size=ACTIONS, x_phi_layers=[128], optimizer="adam", lr_st=8e-4, **sizes)
        for _ in range(2)
    )
    agent = VRDM(first, keep, gamma=0.99, beta_h="auto_1.0", value_layers=[256, 256], policy_layers=[256, 256])
    random = np.random.default_rng(0)

    def noise(*shape: int) -> np.ndarray:
        return random.standard_normal((EPISODES, LENGTH, *shape)).astype(np.float32)

    obs, action, reward = noise(OBS), np.tanh(noise(ACTIONS)), noise()
    replay = obs, action, reward, np.zeros_like(reward), np.ones_like(reward)

    def step(number: int) -> None:
        agent.select(obs[0, number % LENGTH], float(reward[0, number % LENGTH]))
        if number % INTERVAL == 0:
            agent.learn_st(False, True, *replay, times=1, minibatch_size=4)
        agent.learn_rl_sac(*replay, times=1, minibatch_size=4, reward_scale=1.0, seq_len=64)

    agent.init_episode(np.zeros(OBS + 1, np.float32))
    for number in range(INTERVAL):
        step(number)
    began = time.perf_counter()
    for number in range(THEIRS):
        step(number)
    return 1e3 * (time.perf_counter() - began) / THEIRS


def main(checkout: str, python: str) -> None:
    """Time all `ROUNDS` times in turn, each in a process of its own; print medians and median ratios."""
    commands = dict.fromkeys(OURS_WITH, sys.executable) | {"authors": python}
    times: dict[str, list[float]] = {who: [] for who in commands}
    for number in range(ROUNDS):
        for who, interpreter in commands.items():
            command = [interpreter, __file__, "--run", who, checkout]
            output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            times[who].append(float(output.split()[-1]))
        print(f"round {number + 1}: " + ", ".join(f"{who} {each[-1]:.1f}" for who, each in times.items()), "ms a step")
    for who in OURS_WITH:
        ratios = [theirs / mine for mine, theirs in zip(times[who], times["authors"], strict=True)]
        print(f"{who}: median {statistics.median(times[who]):.1f} ms, median ratio {statistics.median(ratios):.1f}")


if __name__ == "__main__":
    if len(sys.argv) == 4 and sys.argv[1] == "--run":
        who, checkout = sys.argv[2:]
        print(theirs(checkout) if who == "authors" else ours(**OURS_WITH[who]))
    elif len(sys.argv) == 3:
        main(*sys.argv[1:])
    else:
        sys.exit("usage: python benchmarks/race_authors.py CHECKOUT PYTHON_WITH_TORCH")
