"""What signals do: the first stops a training, the second ends the program, and nobody sees a traceback of ours."""

import os
import signal
import subprocess
import sys
import time

import pytest

from beliefrl.training import stop

SLEEPER = """
import hashlib
from beliefrl.training.stop import Requests
with Requests():
    print("ready", flush=True)
    hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)  # one instruction of Python, as a compiled function is
"""


def test_a_second_signal_ends_the_program_at_once():
    command = [sys.executable, "-c", "import signal; signal.signal(2, signal.default_int_handler)\n" + SLEEPER]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "ready\n"
            process.send_signal(signal.SIGINT)
            time.sleep(0.5)
            assert process.poll() is None
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=20) == 130
        finally:
            process.kill()


def test_ctrl_c_waits_while_a_program_imports():
    """Raised in an import, it could be lost; it comes at the end, or where a training looks for requests."""
    steps, before = [], signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), stop.waiting():  # noqa: PT012
        os.kill(os.getpid(), signal.SIGINT)
        steps.append("imported")
    assert steps == ["imported"]
    heard = []
    with stop.waiting():
        os.kill(os.getpid(), signal.SIGINT)
        with stop.Requests(lambda: heard.append("stopping")) as requests:
            assert (requests.number, heard) == (signal.SIGINT, ["stopping"])
    assert signal.getsignal(signal.SIGINT) is before


def test_a_handler_that_an_environment_has_installed_is_replaced():
    with stop.Requests() as requests:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        requests.renew()
        os.kill(os.getpid(), signal.SIGTERM)
        assert requests.number == signal.SIGTERM


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="this system has no SIGHUP")
@pytest.mark.parametrize("is_ignored", [False, True])
def test_a_closed_terminal_is_a_request_but_not_after_nohup(is_ignored):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if is_ignored else signal.SIG_DFL)
    try:
        with stop.Requests() as requests:
            os.kill(os.getpid(), signal.SIGHUP)
            assert requests.number == (None if is_ignored else signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


ANSWERING = """
import hashlib, os, signal
from beliefrl.training.stop import Requests
with Requests(lambda: print("heard", flush=True)):
    print("ready", flush=True)
    os.kill(os.getpid(), signal.SIGTERM)
    hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)
"""


def test_the_first_signal_is_answered_while_a_compiled_function_runs():
    with subprocess.Popen([sys.executable, "-c", ANSWERING], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert [process.stdout.readline(), process.stdout.readline()] == ["ready\n", "heard\n"]
            assert process.poll() is None
        finally:
            process.kill()


def test_signals_that_come_together_are_one_request():
    with subprocess.Popen([sys.executable, "-c", SLEEPER], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "ready\n"
            for _ in range(3):
                process.send_signal(signal.SIGTERM)
                time.sleep(0.02)
            time.sleep(0.5)
            process.send_signal(signal.SIGTERM)  # of a sweep, after that of a scheduler
            time.sleep(0.5)
            assert process.poll() is None
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=20) == 130
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("number", "seconds", "is_another"),
    [
        (signal.SIGINT, 0.1, False),
        (signal.SIGINT, 1.0, True),
        (signal.SIGTERM, 10.0, False),
        (signal.SIGTERM, 31.0, True),
    ],
)
def test_a_second_signal_is_a_request_of_its_own_after_some_time(number, seconds, is_another):
    assert stop._is_another(number, seconds) == is_another


TRAINING = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
import beliefrl

def train():
    agent = beliefrl.make_agent("sac-mlp", step_start_rl=400_000, policy_layers=(8,), value_layers=(8,))
    beliefrl.train(agent, "pendulum", "run", steps=400_000)
"""


def stopped(folder, script, number):
    """Exit code, output and errors of a script, of which a training gets a signal while it explores."""
    command = [sys.executable, "-u", "-c", TRAINING + script]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=folder, text=True, **pipes) as process:
        try:
            for line in process.stdout:
                if line.endswith(" exploring\n"):
                    break
            process.send_signal(number)
            out, err = process.communicate(timeout=300)
        finally:
            process.kill()
    return process.returncode, out, err


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_script_ends_with_one_sentence_and_the_exit_code_of_the_command_line(tmp_path, number, code):
    ended, _, err = stopped(tmp_path, "train()", number)
    assert ended == code
    assert err.startswith("beliefrl: stopped at step ")
    assert "`beliefrl resume run` goes on from there, in Python beliefrl.resume('run')." in err
    assert err.count("\n") == 1


STOPPED = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from beliefrl.training.stop import Requests, Stopped
assert sys.excepthook is sys.__excepthook__  # an import changes nothing

def train():
    with Requests() as requests:
        os.kill(os.getpid(), signal.SIGINT)
        raise Stopped("stopped at step 3.", requests.number)
"""


def python(script, *options, typed=""):
    """A Python process that ran a script, with `typed` as its input."""
    command = [sys.executable, *options, "-c", STOPPED + script]
    return subprocess.run(command, input=typed, capture_output=True, text=True, timeout=300)


def test_a_program_may_catch_it_and_other_errors_keep_their_traceback():
    done = python("try:\n    train()\nexcept KeyboardInterrupt as error:\n    print(error.exit_code)\n1 / 0")
    assert (done.returncode, done.stdout) == (1, "130\n")
    assert "Traceback" in done.stderr
    assert "ZeroDivisionError" in done.stderr


def test_an_excepthook_of_the_program_still_gets_the_other_errors():
    done = python("sys.excepthook = lambda kind, *_: print(kind)\ntry:\n    train()\nexcept Stopped:\n    1 / 0")
    assert done.stdout == "<class 'ZeroDivisionError'>\n"
    done = python("sys.excepthook = lambda kind, *_: print(kind)\ntrain()")
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "beliefrl: stopped at step 3.\n")


def test_an_interactive_session_returns_to_the_prompt():
    done = python("", "-i", typed="train()\nprint('here', 6 * 7)\n")
    assert done.returncode == 0
    assert "here 42" in done.stdout
    assert "beliefrl: stopped at step 3." in done.stderr
    assert "Traceback" not in done.stderr


TWICE = """
import time
with Requests() as requests:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.5)
    os.kill(os.getpid(), signal.SIGINT)
"""


def test_a_second_interrupt_does_not_end_an_interactive_session():
    done = python(TWICE, "-i", typed="print('here', 6 * 7)\n")
    assert (done.returncode, "here 42" in done.stdout) == (0, True)
    assert "beliefrl: stopped at once" in done.stderr


@pytest.mark.extra
def test_a_notebook_shows_the_sentence():
    from beliefrl.training.stop import Stopped

    shell = pytest.importorskip("IPython.core.interactiveshell").InteractiveShell()
    try:
        script = "from beliefrl.training.stop import Stopped\nraise Stopped('stopped at step 3.', 2)"
        with pytest.MonkeyPatch.context() as patch:
            shown = []
            patch.setattr(shell, "_showtraceback", lambda kind, error, lines: shown.extend(lines))
            result = shell.run_cell(script)
        assert isinstance(result.error_in_exec, Stopped)
        assert shown == ["beliefrl: stopped at step 3."]
    finally:
        shell.history_manager.end_session()


# A full disk: one sentence that says how to go on, whichever file has no room, and nothing stays held.

FILES = {  # where a file begins to have no room: which function of which class is called then
    "metrics": "beliefrl.runs.recorder.Recorder.log",
    "tensorboard": "beliefrl.runs.trackers.TensorBoard.flush",
    "checkpoint": "beliefrl.runs.checkpoint.Checkpoints.save",
    "agent": "beliefrl.runs.recorder.Recorder.save",
    "results": "beliefrl.runs.recorder.Recorder.finish",
}
LIMITED = """
import importlib, resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
module, kind, name = sys.argv[1].rsplit(".", 2)
kind = getattr(importlib.import_module(module), kind)
real = getattr(kind, name)
def limited(*given, **named):
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, resource.RLIM_INFINITY))  # no file may grow beyond 10 bytes
    return real(*given, **named)
setattr(kind, name, limited)
from beliefrl import train
from beliefrl import UserError, agents
from beliefrl.runs.recorder import Recorder
small = dict(step_start_rl=20, pretrain_updates=5, batch_size=8, policy_layers=(8,), value_layers=(8,))
agent = agents.make("sac-mlp", **small)
try:
    train(agent, "pendulum-v", "run", steps=40, checkpoint_steps=20, eval_every=20, eval_episodes=1)
except UserError as error:
    print(error, file=sys.stderr)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
Recorder("run", None).close()  # it is locked no more
"""


MARKS = {"metrics": pytest.mark.slow, "checkpoint": pytest.mark.slow}


@pytest.mark.parametrize("file", [pytest.param(name, marks=MARKS.get(name, pytest.mark.nightly)) for name in FILES])
def test_a_disk_that_is_full_is_one_sentence(tmp_path, file):
    command = [sys.executable, "-c", LIMITED, FILES[file]]
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert "cannot be written (File too large): fix that, then `beliefrl resume run` goes on." in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.returncode == 0
