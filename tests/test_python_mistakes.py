"""Mistakes in calls from Python are clear sentences, in a process whose types beartype does not check."""

import json
import subprocess
import sys

MISTAKES = {
    "train(VRMAgent, 'pendulum')": "VRMAgent is a class: give an agent, VRMAgent().",
    "train(5, 'pendulum')": "int is no agent",
    "make_agent(VRMAgent)": "is not the name of an agent: make_agent takes a name",
    "make_task('pendulum', observe=1.5)": "observe=1.5 cannot be understood",
    "make_task('pendulum', faults=0.1)": "faults=0.1 is impossible: give Faults(...), or a dictionary of its fields.",
    "with_faults(make_task('pendulum'), {'nose': 0.1})": "There is no fault 'nose'",
    "with_faults(5, {'noise': 0.1})": "5 is no task: give a task (make_task makes one from its name)",
    "observe('pendulum', (1,))": "'pendulum' is no task",
    "observe(make_task('pendulum'), 1)": "observe=1 is not a list of indices: give a tuple, such as (0, 1).",
    "observe(make_task('gym:Pendulum-v1'), 1)": "observe=1 is not a list of indices",
    "observe(make_task('gym:Pendulum-v1'), '01')": "observe='01' is not a list of indices",
    "write_report([])": "There are no runs",
    "observe(make_task('pendulum'), 'velocities')": "observe='velocities' is not a list of indices",
    "Experiment('vrm', 'pendulum', seeds=3)": "seeds=3 is impossible: give the seed numbers",
    "Experiment(3, 'pendulum')": "agent=3 is impossible: give its name.",
    "Experiment('vrm', 'pendulum', [1])": "settings=[1] is impossible: give a dictionary",
    "Experiment('vrm', 'pendulum', observe=2.5)": "observe=2.5 is impossible: give entries of the observation.",
    "Experiment('vrm', 'pendulum', seeds='01')": "seeds='01' is impossible: give the seed numbers",
    "grid('vrm', 'pendulum', [0.9])": "settings=[0.9] is impossible: give a dictionary",
    "sweep([Experiment('vrm', 'pendulum')], 'out', ray=3)": "ray=3 is impossible: give HOST:PORT",
    "sweep([Experiment('vrm', 'pendulum')], 3)": "3 is no path: give a text or a pathlib.Path.",
    "tune(3, 'pendulum')": "agent=3 is impossible",
    "tune('vrm', 'pendulum', ranges=[1])": "ranges=[1] is impossible: give a dictionary",
    "tune('vrm', 'pendulum', only=3)": "only=3 is impossible: give a list of names.",
    "tune('vrm', 'pendulum', constants=3)": "constants=3 is impossible: give a dictionary",
    "demo('pendulum-v', 3)": "3 is no path",
    "make_task(3)": "3 is not the name of a task",
    "make_task('gym:Pendulum-v1', measures=3)": "measures=3 is impossible: give a tuple of names, ('success',).",
    "make_env(3)": "3 is no task",
    "train('vrm', 'pendulum', 3)": "3 is no path",
    "train('vrm', 'pendulum', callback=3)": "callback=3 is impossible: give a function of an Event.",
    "film(3)": "3 is not a run",
    "write_report(3)": "3 is no path",
    "grid(['vrm'], ['pendulum'], {'lr_critic': 3e-4})": "lr_critic=0.0003 is not a list of values: give [0.0003]",
    "sweep(Experiment('vrm', 'pendulum'), 'out')": "experiments must be a list of beliefrl.Experiment",
    "sweep(['vrm'], 'out')": "experiments must be a list of beliefrl.Experiment",
    "sweep(5, 'out')": "experiments must be a list of beliefrl.Experiment",
    "sweep([Experiment('vrm', 'pendulum')], 'out', workers=-9)": "workers=-9 is impossible",
    "sweep([Experiment('vrm', 'pendulum')], 'out', seeds_per_run=0)": "seeds_per_run=0 is impossible",
    "video('missing', 'video.gif', fps='5')": "fps='5' is impossible",
    "film('missing')": "no run folder missing",
    "draw_curve('missing')": "no run folder missing",
    "write_report('missing')": "There is no folder missing",
}

CALLS = """
import json, sys
from beliefrl import *
from beliefrl import UserError, observe
from beliefrl.agents.vrm import VRMAgent
for call, phrase in json.load(sys.stdin).items():
    try:
        eval(call)
    except UserError as error:
        assert phrase in str(error), f"{call}: {error}"
    else:
        raise AssertionError(call)
"""


def test_mistakes_in_calls_are_sentences(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", CALLS], input=json.dumps(MISTAKES), cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.iterdir())
