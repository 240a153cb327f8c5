"""Keep what runs have measured: `python benchmarks/results/keep.py results/NAME.json.gz RUNS ...`.

RUNS are runs, finished or not, folders that hold runs, or other files of results. What is in the file already stays; a
run that is packed again, as it has gone on since, takes its old place. What is kept: `beliefrl.analysis.results`.
"""

import pathlib
import sys

from beliefrl import agents
from beliefrl.analysis import groups, results

if len(sys.argv) < 3:
    sys.exit(__doc__)
file, *given = map(pathlib.Path, sys.argv[1:])
runs = groups.find([file, *given] if file.exists() else given).runs
results.write(file, runs, agents.defaults())
print(f"{file}: {len(results.read(file))} runs, {file.stat().st_size / 1000:.0f} kB")
