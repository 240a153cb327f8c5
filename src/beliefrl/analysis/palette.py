"""One colour for each line of a figure: an agent has the same one in every picture and on every page.

Lines of one agent with different settings differ in their dashes too.

The colours of the agents differ for colour-blind readers too (by Machado et al. 2009), and stand out 3 to 1 from white.
"""

from collections.abc import Sequence

AGENTS = {
    "vrm": "#0072b2",
    "sac-mlp": "#d55e00",
    "sac-lstm": "#009e73",
    "slac": "#cc79a7",
    "vrm-single": "#332288",
    "vrm-first": "#aa3377",
    "vrm-keep": "#661100",
    "vrm-deterministic": "#117733",
}
OTHERS = ("#777777", "#8f8f1f", "#3c8fc0", "#b37700", "#5e4fa2", "#0f8b8d")


def _plain_first(labels: Sequence[str]) -> list[str]:
    """Each label once, an agent's plain name before those with settings."""
    return sorted(dict.fromkeys(labels), key=lambda label: " " in label)


def colours(labels: Sequence[str]) -> dict[str, str]:
    """A colour "#rrggbb" for each label, whose first word is the agent's name.

    A known agent has its own; further labels of it and other agents have the next of the others, in the order of the
    labels (plain names first) and from the start again when they are used up.
    """
    chosen: dict[str, str] = {}
    others = 0
    for label in _plain_first(labels):
        own = AGENTS.get(label.partition(" ")[0])
        if own is None or own in chosen.values():
            own, others = OTHERS[others % len(OTHERS)], others + 1
        chosen[label] = own
    return {label: chosen[label] for label in labels}


def dashes(labels: Sequence[str]) -> dict[str, int]:
    """How many lines of its agent come before each label, the agent's plain name first: the number of its dashes."""
    before: dict[str, int] = {}
    chosen = {}
    for label in _plain_first(labels):
        agent = label.partition(" ")[0]
        chosen[label] = before.get(agent, 0)
        before[agent] = chosen[label] + 1
    return {label: chosen[label] for label in labels}
