"""Draw docs/results/cartpole/horizon.png and .pdf: why CartPole takes so long.

    python benchmarks/results/horizon.py EARLY RUN ...

EARLY is the folder of a training whose episodes still fail. Its saved agent plays the episodes of the lower panels. The
first panel draws the values of all runs. So the runs must be folders of trainings, with all their updates.
"""

import pathlib
import sys

import numpy as np

import beliefrl
from beliefrl.analysis.figures import figure, save
from beliefrl.analysis.palette import AGENTS
from beliefrl.training.evaluation import restore_seed
from beliefrl.viewing.episodes import Player

PICTURE = pathlib.Path(__file__).parents[2] / "docs" / "results" / "cartpole" / "horizon"
EPISODES = range(8)
DASHES = ("-", "--", ":", "-.")
LIMIT = 2.4  # m, where the track ends
AHEAD = 200  # steps from where the cart begins to drift to where the track ends
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
    agent, task, state, _ = restore_seed(run, None, None)
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
        axis.set(xlabel="time (s)", ylabel=name)
    steps = max(row["step"] for row in run.rows(run.seeds[0], "evaluation"))
    title = f"{len(EPISODES)} episodes of {run.config['agent']} on {run.config['task']} after {steps:,} steps"
    top.set_title(title, loc="left", fontsize=10)
    for length, x, theta in ends:
        print(f"{length:5} steps, then x = {x:5.2f} m, θ = {np.degrees(theta):5.1f}°")


def cost_ahead(tau, n, count, gamma=0.99, ahead=AHEAD):
    """What it costs to leave the track in so many steps, as V̄ has it after 1, 2, ... `count` updates.

    The value of a state that far from the end, below that of one without an end, where V and Q learn at once: each
    update moves V̄ by τ towards what lies n steps nearer to the end.
    """
    distance = np.arange(1, ahead + 1)
    known, costs = np.zeros(ahead + 1), np.empty(count)
    known[0] = 1 / (1 - gamma)
    for update in range(count):
        beyond = gamma ** np.minimum(distance, n) * known[np.maximum(distance - n, 0)]
        known[1:] += tau * (beyond - known[1:])
        costs[update] = known[-1]
    return costs


def draw_costs(axis):
    """How late the end of the track is noticed, with the paper's settings and others."""
    for (tau, n), dash in zip(((0.005, 1), (0.02, 1), (0.005, 5), (0.02, 5)), DASHES, strict=True):
        label = f"τ = {tau}, n = {n}" + (" (the paper)" if (tau, n) == (0.005, 1) else "")
        axis.plot(cost_ahead(tau, n, 60_000), dash, color="black", linewidth=1.2, label=label)
    axis.set(xlabel="updates $k$ of the controller", ylabel="value")
    axis.set_title(f"What leaving the track in {AHEAD} steps costs, as V̄ has it", loc="left", fontsize=10)
    axis.legend(frameon=False, fontsize=8, loc="center", bbox_to_anchor=(0.4, 0.5))


def main():
    """The picture."""
    runs = [beliefrl.Run(path) for path in sys.argv[1:]]
    made = figure(9.6, 6.6)
    values, costs, top, below = made.subplots(2, 2).flat
    draw_values(values, runs)
    draw_costs(costs)
    draw_episodes(top, below, runs[0])
    for axis in (values, costs, top, below):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    print(save(made, PICTURE))


main()
