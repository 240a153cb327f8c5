"""Colours and dashes of the lines of a figure. An agent has the same colour in every figure and report.

Lines of one agent with different settings have different dashes, too. Colour-blind readers can distinguish the agents'
colours (simulated after Machado et al. 2009). Their contrast to white is at least 3 to 1.
"""

from collections.abc import Sequence

AGENTS = {
    "vrm": "#0072b2",
    "sac-mlp": "#d55e00",
    "sac-lstm": "#009e73",
    "slac": "#cc79a7",
    "predictive-sac": "#9a8700",
    "vrm-single": "#332288",
    "vrm-first": "#aa3377",
    "vrm-keep": "#661100",
    "vrm-deterministic": "#117733",
}
OTHERS = ("#777777", "#8f8f1f", "#3c8fc0", "#b37700", "#5e4fa2", "#0f8b8d")


def _plain_first(labels: Sequence[str]) -> list[str]:
    """The labels without duplicates; names without settings come first."""
    return sorted(dict.fromkeys(labels), key=lambda label: " " in label)


def colours(labels: Sequence[str]) -> dict[str, str]:
    """A colour "#rrggbb" for each label, whose first word is the agent's name.

    The first label of a known agent has the agent's colour. All others take the colours of OTHERS in turn, in the order
    of the labels, names without settings first.
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
    """The index of each label's dash pattern: its position among the labels of its agent, the plain name first."""
    before: dict[str, int] = {}
    chosen = {}
    for label in _plain_first(labels):
        agent = label.partition(" ")[0]
        chosen[label] = before.get(agent, 0)
        before[agent] = chosen[label] + 1
    return {label: chosen[label] for label in labels}
