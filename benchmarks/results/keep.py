"""Write the results of runs to a file: `python benchmarks/results/keep.py results/NAME.json.gz RUNS ...`.

RUNS are runs, finished or not, folders that contain runs, or other files of results. Runs that are already in the file
stay there. If a run is given again, for example after more steps, it replaces its earlier version. The format of the
file is described in `beliefrl.analysis.results`.
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
