"""Draw horizon.png and .pdf in this folder: why CartPole takes so long.

    python docs/results/cartpole/draw.py EARLY RUN ...

EARLY is a run whose episodes still fail, and whose agent plays the episodes of the second panel; of RUN ... the values
are drawn, and of EARLY too.
"""

import pathlib
import sys

import numpy as np

import beliefrl
from beliefrl.analysis.palette import AGENTS
from beliefrl.episodes import Player
from beliefrl.evaluation import restore_seed
from beliefrl.figures import figure, save

EPISODES = range(8)
DASHES = ("-", "--", ":", "-.")
LIMIT = 2.4  # m, where the track ends
TILT = np.radians(12.0)  # rad, where the pole counts as fallen


def updates(run, steps):
    """How many updates the controller has made after so many environment steps."""
    settings = run.config["hyperparameters"]
    return steps - settings["step_start_rl"] + settings.get("pretrain_updates", 0)  # VRM's pre-training is its model's


def draw_values(axis, runs):
    """min Q of the replay's states in every run, and the values that V̄ can have come to at most."""
    longest = 0
    for dash, run in zip(DASHES, runs, strict=False):
        name = run.config["agent"]
        for index, seed in enumerate(run.seeds):
            rows = [row for row in run.rows(seed, "update") if row["step"] % 500 == 0]
            count = [updates(run, row["step"]) for row in rows]
            label = f"{name} on {run.config['task']}" if index == 0 else None
            axis.plot(count, [row["q"] for row in rows], dash, color=AGENTS[name], linewidth=1.2, label=label)
            longest = max(longest, count[-1])
    settings = runs[0].config["hyperparameters"]
    tau, gamma = settings["tau"], settings["gamma"]
    count = np.linspace(0, longest, 200)
    bound = (1 - np.exp(-tau * (1 - gamma) * count)) / (1 - gamma)
    axis.plot(count, bound, color="black", linewidth=2, alpha=0.5, label=r"$(1 - e^{-\tau(1-\gamma)k})/(1-\gamma)$")
    axis.set(xlabel="updates $k$ of the controller", ylabel="mean of min Q over the replay")
    axis.set_title("Values cannot grow faster", loc="left", fontsize=10)
    axis.legend(frameon=False, fontsize=8)


def draw_episodes(top, below, run):
    """Where the cart is, and how far the pole tilts, in episodes of one agent."""
    agent, task, state = restore_seed(run, None, None)
    ends = []
    with Player(agent, task, state, rendered=True) as player:
        for episode in EPISODES:
            player.play(episode, sampled=True)
            states = player.environment.unwrapped.states
            seconds = np.arange(len(states)) * 0.02
            x, theta = (np.array([float(getattr(each, name)) for each in states]) for name in ("x", "theta"))
            top.plot(seconds, x, color=AGENTS["vrm"], linewidth=0.9, alpha=0.7)
            below.plot(seconds, theta, color=AGENTS["vrm"], linewidth=0.9, alpha=0.7)
            ends.append((len(states) - 1, float(x[-1]), float(theta[-1])))
    for axis, bound, name in ((top, LIMIT, "cart $x$ (m)"), (below, TILT, "pole θ (rad)")):
        for edge in (-bound, bound):
            axis.axhline(edge, color="black", linewidth=0.8, linestyle="--")
        axis.set_ylabel(name)
    steps = max(row["step"] for row in run.rows(run.seeds[0], "evaluation"))
    title = f"{len(EPISODES)} episodes of {run.config['agent']} on {run.config['task']} after {steps:,} steps"
    top.set_title(title, loc="left", fontsize=10)
    below.set_xlabel("time (s)")
    for length, x, theta in ends:
        print(f"{length:5} steps, then x = {x:5.2f} m, θ = {np.degrees(theta):5.1f}°")


def main():
    """The picture."""
    runs = [beliefrl.Run(path) for path in sys.argv[1:]]
    made = figure(9.0, 3.6)
    left, right = made.subplots(1, 2, width_ratios=(1, 1), subplot_kw={"visible": True})
    place = right.get_subplotspec()
    right.remove()
    halves = place.subgridspec(2, 1)
    top = made.add_subplot(halves[0])
    below = made.add_subplot(halves[1], sharex=top)
    draw_values(left, runs)
    draw_episodes(top, below, runs[0])
    top.tick_params(labelbottom=False)
    for axis in (left, top, below):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    print(save(made, pathlib.Path(__file__).with_name("horizon")))


main()
