"""What each command does: parse its options, call the library, print. A command is a function and a line here."""

from collections.abc import Callable, Sequence

from beliefrl.commands import bench, lists, pictures, runs, training

COMMANDS: dict[str, Callable[[Sequence[str]], None]] = {
    "train": training.train,
    "resume": training.resume,
    "show": runs.show,
    "evaluate": runs.evaluate,
    "export": runs.export,
    "predict": pictures.predict,
    "video": pictures.video,
    "film": pictures.film,
    "tasks": lists.list_tasks,
    "agents": lists.list_agents,
    "bench": bench.bench,
}
