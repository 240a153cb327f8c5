"""A second Ctrl-C is heard while a compiled function runs."""

import signal
import subprocess
import sys
import time

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
            assert process.poll() is None
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=20) == 143
        finally:
            process.kill()
