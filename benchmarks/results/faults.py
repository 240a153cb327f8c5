"""Measure what agents keep of their return on the pendulum as noise and lost observations grow, and draw it.

    python benchmarks/results/faults.py            # train, then write the files
    python benchmarks/results/faults.py --quick    # the same with 300 steps, in runs/faults-quick
    python benchmarks/results/faults.py --draw results/faults.json.gz

The trainings are a sweep in runs/faults: a stopped one goes on with the same command. The files are
results/faults.json.gz and docs/results/faults/returns.png, and a table in Markdown is printed. With --quick, all files
are in the sweep's folder. The share that an agent keeps is 100 % for its return without faults, and 0 % for that of a
random policy.
"""

import argparse
import pathlib

import numpy as np

import beliefrl
from beliefrl import agents
from beliefrl.analysis import figures, groups, results
from beliefrl.analysis.aggregate import BOUNDS
from beliefrl.analysis.figures import standard_error
from beliefrl.analysis.panels import colours

AGENTS = ("sac-mlp", "predictive-sac")
TASK = "pendulum"
LEVELS = {"noise": (0.3, 1.0), "flicker": (0.2, 0.5)}
LABELS = {"noise": "standard deviation of the noise", "flicker": "probability that an observation is lost"}
RANDOM = BOUNDS[TASK][0]


def experiments(seeds, levels, **settings):
    """Every agent without faults, and at each level of each fault. It is evaluated at its last step only."""
    fixed = {"seeds": seeds, "eval_every": settings["steps"], "eval_episodes": 20, **settings}
    bare = beliefrl.grid(AGENTS, [TASK], **fixed)
    return bare + [each for name in levels for each in beliefrl.grid(AGENTS, [TASK], {name: levels[name]}, **fixed)]


def returns(runs):
    """{agent: {(fault, level): final returns (seed,) with mode actions}}; without faults the level is 0 of each."""
    table = {agent: {} for agent in AGENTS}
    for group in groups.groups(runs, agents.defaults(), agents.before()):
        final = group.curve("mode").seeds[:, -1]
        faults = group.runs[0].config.get("faults") or dict.fromkeys(LEVELS, 0.0)
        table[group.agent] |= dict.fromkeys(faults.items(), final)
    return table


def draw(table, path):
    """A panel for each fault: the return of each agent over the level of the fault, mean, S.E.M. and single seeds."""
    made, colour = figures.figure(8.0, 3.2), colours(AGENTS)
    axes = made.subplots(1, len(LEVELS), sharey=True)
    for axis, name in zip(axes, LEVELS, strict=True):
        for agent, measured in table.items():
            levels = sorted(level for fault, level in measured if fault == name)
            finals = [measured[name, level] for level in levels]
            mean, error = (np.array([of(final) for final in finals]) for of in (np.nanmean, standard_error))
            place = np.arange(len(levels))
            axis.plot(place, mean, "o-", color=colour[agent], label=agent)
            axis.fill_between(place, mean - error, mean + error, color=colour[agent], alpha=0.2, linewidth=0)
            for at, final in zip(place, finals, strict=True):
                axis.plot(np.full(len(final), at), final, ".", color=colour[agent], alpha=0.5, markersize=4)
            axis.set_xticks(place, [f"{level:g}" for level in levels])
        axis.axhline(RANDOM, color="#777777", linestyle=":", linewidth=1, label="random policy")
        axis.set_xlabel(LABELS[name])
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("return")
    axes[0].legend(frameon=False, fontsize=8)
    return figures.save(made, path)


def print_table(table):
    """The mean ± S.E.M. of the returns, and the share that an agent keeps, in Markdown."""
    print("| fault | " + " | ".join(f"`{agent}`" for agent in table) + " |")
    print("| --- |" + " ---: |" * len(table))
    rows = dict.fromkeys(item for measured in table.values() for item in sorted(measured) if item != ("flicker", 0.0))
    for name, level in sorted(rows, key=lambda item: (item[1] != 0, *item)):
        cells = []
        for measured in table.values():
            final, whole = measured[name, level], np.nanmean(measured["noise", 0.0])
            kept = (np.nanmean(final) - RANDOM) / (whole - RANDOM)
            cells.append(f"{np.nanmean(final):.0f} ± {standard_error(final):.0f} ({kept:.0%})")
        print(f"| {f'`--{name} {level:g}`' if level else 'none'} | " + " | ".join(cells) + " |")


def main():
    """Train, write the results, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=6000, help="environment steps of each seed")
    parser.add_argument("--seeds", type=int, default=3, help="seeds of each agent at each level")
    parser.add_argument("--quick", action="store_true", help="one seed, 300 steps, one level of each fault")
    parser.add_argument("--out", type=pathlib.Path, default=None, help="the sweep's folder")
    parser.add_argument("--draw", type=pathlib.Path, default=None, help="draw a file of results, and train nothing")
    given = parser.parse_args()
    out = given.out or pathlib.Path("runs/faults-quick" if given.quick else "runs/faults")
    results_file, picture = pathlib.Path("results/faults.json.gz"), pathlib.Path("docs/results/faults/returns.png")
    if given.quick:
        results_file, picture = out / results_file.name, out / picture.name
    if given.draw is None:
        if given.quick:
            highest = {name: levels[-1:] for name, levels in LEVELS.items()}
            planned = experiments(1, highest, steps=300, step_start_rl=100, pretrain_updates=10)
        else:
            planned = experiments(given.seeds, LEVELS, steps=given.steps)
        beliefrl.sweep(planned, out)
        results.write(results_file, groups.find([out]).runs, agents.defaults())
        print(f"wrote {results_file}")
    table = returns(results.read(given.draw or results_file))
    print_table(table)
    print(f"wrote {draw(table, picture)}")


if __name__ == "__main__":
    main()
