"""The programs as processes of their own: started, watched with deadlines, and always ended."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep  # noqa: TID251  other processes live in real time
from typing import Any

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 60.0
"""Only a test that is about to fail waits so long."""
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error"}
"""A warning in any program is an error there, too."""


def eventually(what: str, condition: Callable[[], Any], timeout_s: float = TIMEOUT_S) -> Any:
    """Return the condition's first true value; fail when there is none in time."""
    deadline = monotonic() + timeout_s
    while not (value := condition()):
        assert monotonic() < deadline, f"{what}: not within {timeout_s:g} s"
        sleep(0.05)
    return value


@dataclass(frozen=True)
class Program:
    """A program that has been started, its output in files."""

    process: subprocess.Popen[bytes]
    out: Path
    err: Path

    @property
    def stdout(self) -> str:
        return self.out.read_text()

    @property
    def stderr(self) -> str:
        return self.err.read_text()

    def send(self, signum: int) -> None:
        self.process.send_signal(signum)

    def end(self, signum: int = signal.SIGINT, timeout_s: float = TIMEOUT_S) -> int:
        """Send a signal and return the exit code."""
        self.send(signum)
        return self.wait(timeout_s)

    def wait(self, timeout_s: float = TIMEOUT_S) -> int:
        return self.process.wait(timeout_s)


def _mind_ctrl_c() -> None:
    """Undo what a shell does to what it starts in the background: tests that run there send Ctrl-C all the same."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def program(folder: Path, *arguments: str, **environment: str) -> Iterator[Program]:
    """Run ``python -m`` with the arguments, in a process group of its own; killed at the end if it still runs."""
    folder.mkdir(parents=True, exist_ok=True)
    number = len(list(folder.glob("*.stdout")))
    out, err = (folder / f"{number}-{arguments[0]}.{end}" for end in ("stdout", "stderr"))
    with out.open("wb") as stdout, err.open("wb") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            cwd=folder,
            env={**ENVIRONMENT, **environment},
            start_new_session=True,
            preexec_fn=_mind_ctrl_c,
        )
    try:
        yield Program(process, out, err)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def a_socket() -> socket.socket:
    """Return a socket at a free port of the loopback."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.settimeout(TIMEOUT_S)
    return sock


def free_port() -> int:
    """Return a port at which nobody listens."""
    with closing(a_socket()) as sock:
        return int(sock.getsockname()[1])


def listens(port: int) -> bool:
    """Whether somebody is bound to a port of the loopback; an empty datagram tells."""
    with closing(a_socket()) as sock:
        sock.connect(("127.0.0.1", port))
        sock.settimeout(0.01)
        sock.send(b"")
        try:
            sock.recv(1)
        except ConnectionRefusedError:
            return False
        except TimeoutError:
            return True
    return True


def samples_in(recording: Path, topic: str = "plant/truth") -> int:
    """Count the messages of a topic that have reached a recording, finished or not."""
    if not recording.exists():
        return 0
    channels, count = {}, 0
    with recording.open("rb") as file:
        try:
            for record in StreamReader(file).records:
                if isinstance(record, Channel):
                    channels[record.id] = record.topic
                elif isinstance(record, Message):
                    count += channels[record.channel_id] == topic
        except (McapError, ValueError, OSError):
            pass  # the end of what has been written
    return count


def topics_in(recording: Path) -> dict[str, int]:
    """Return the number of messages of each topic, as the summary at the end of a finished recording says."""
    with recording.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None, f"{recording} is not finished"
        assert summary.statistics is not None
        counts = summary.statistics.channel_message_counts
        return {channel.topic: counts.get(i, 0) for i, channel in summary.channels.items()}


def children_of(pid: int) -> dict[int, str]:
    """Return process id and command line of each child of a process, from ``/proc``."""
    children = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                parent = int(_stat(folder)[1])
                line = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue  # it has ended meanwhile
            if parent == pid:
                children[int(folder.name)] = line
    return children


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and waits for its parent to ask does not."""
    try:
        os.kill(pid, 0)
        return _stat(Path(f"/proc/{pid}"))[0] != "Z"
    except OSError:
        return False


def _stat(folder: Path) -> list[str]:
    """Return state and parent of a process; its name, in parentheses before them, may hold anything."""
    return (folder / "stat").read_text().rpartition(")")[2].split()[:2]
