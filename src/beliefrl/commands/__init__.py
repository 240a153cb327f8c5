"""What each command does: parse its options, call the library, print. A command is a function and a line here."""

from collections.abc import Callable, Sequence

from beliefrl.commands import bench, figure, lists, pictures, report, runs, sweep, training

COMMANDS: dict[str, Callable[[Sequence[str]], None]] = {
    "train": training.train,
    "resume": training.resume,
    "sweep": sweep.sweep,
    "figure": figure.figure,
    "show": runs.show,
    "evaluate": runs.evaluate,
    "export": runs.export,
    "report": report.report,
    "predict": pictures.predict,
    "video": pictures.video,
    "film": pictures.film,
    "tasks": lists.list_tasks,
    "agents": lists.list_agents,
    "bench": bench.bench,
}
