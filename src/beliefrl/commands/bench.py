"""`beliefrl bench`."""

import json
import time
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from beliefrl.commands.arguments import agent_name, agent_options, parse
from beliefrl.runs.options import Precision

STARTED = time.time()


def bench(argv: Sequence[str]) -> None:
    """`beliefrl bench AGENT ...`, `beliefrl bench all ...`."""
    from beliefrl import agents

    name, rest = agent_name(argv, "bench")

    def option(kind: Any, default: Any, help: str) -> tuple[Any, Any]:
        return Annotated[kind, tyro.conf.arg(help=help)], default

    own = {
        "obs": option(int, 6, "Size of the observation; the default is that of velocities-only Hopper."),
        "actions": option(int, 3, "Size of the action; the default is that of Hopper."),
        "seeds": option(int, 1, "Seeds trained side by side in one program."),
        "precision": option(Precision, "float32", "Precision of matrix products, as in a training."),
        "json": option(bool, False, "Print one JSON object."),
    }
    options = parse(agent_options(None if name == "all" else agents.make(name), own), rest, f"beliefrl bench {name}")
    from beliefrl.training.bench import bench as run_bench

    given = (options.obs, options.actions, options.seeds, options.precision)
    if name == "all":
        results = {each: run_bench(agents.make(each), *given) for each in agents.AGENTS}
    else:
        results = run_bench(options.agent, *given, STARTED)
    if options.json:
        print(json.dumps(results))
    elif name == "all":
        from rich.console import Console

        from beliefrl.training.display import scalability_table

        Console().print(scalability_table(results, options.obs, options.actions))
    else:
        for key, value in results.items():
            print(f"{key:<28}{value:,.3f}" if isinstance(value, float) else f"{key:<28}{value}")
