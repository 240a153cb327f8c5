"""The commands of the command line. Each is a function that parses options, calls the library and prints."""

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
