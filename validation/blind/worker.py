"""What diagnoses one case of the blind protocol, in a process of its own: it knows a folder and nothing else.

From before the diagnosis on, the process is kept out of the directory of the run (`keep_out`). The labels
are not there anyway while cases are diagnosed (`validation.blind.seal`): they are in the memory of the
process that waits for the answers. The wall is there so that a diagnosis cannot come to read them by accident
or by a library's habit (searching folders, caching, starting helpers). It is no prison for code that wants
out.

What the wall stops, each with a test:

- every call of Python that names a path below the directory: opening, listing, copying, linking, renaming,
  and whatever else raises an audit event with a path in it; through symbolic links, too;
- hard links to files of the directory that are there when the wall goes up, wherever they lie;
- paths relative to a descriptor (`dir_fd`), because no directory is opened as a descriptor any more;
- new processes: `subprocess`, `os.system`, `os.fork`, `os.exec*`, `os.posix_spawn`, and `multiprocessing`
  with any way of starting (`spawn`, `forkserver`, `fork`);
- connections to other processes by sockets, which are also how a fork server is asked for a process;
- files of other processes below /proc, their memory among them;
- interpreters beside this one, which would have no wall.

What it leaves open:

- compiled code: `ctypes`, or an extension that opens files itself, raises no event for what it does inside.
  numba needs ctypes, so ctypes cannot be refused;
- whether a file is there, its size and its times: `os.stat` raises no event;
- descriptors that were open before, and hard links that another process makes later;
- code that sets out to undo what is replaced here (`_posixsubprocess.fork_exec`).
"""

from __future__ import annotations

import os
import shutil
import subprocess  # noqa: F401  # its function that starts processes is replaced
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from diagnosis.diagnosis import diagnose
from validation.blind.baselines import baselines
from workflow.diagnose.case_files import load_case
from workflow.diagnose.document import document_of
from workflow.engine import codec
from workflow.engine.executor import Report

# Audit events of Python with which a process begins another one, or something that has no wall.
_PROCESS_EVENTS = (
    "subprocess.Popen",
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.fork",
    "os.forkpty",
    "cpython.PyInterpreterState_New",
)
# And those with which it talks to another one.
_SOCKET_EVENTS = ("socket.connect", "socket.bind", "socket.sendto", "socket.sendmsg")


def keep_out(directory: Path) -> None:
    """Refuse this process what leads below `directory`; there is no way back.

    Parameters
    ----------
    directory
        Of the blind run. Links in its path are followed now.

    Notes
    -----
    Refused calls raise PermissionError. What is stopped and what is left open is listed at the head of this
    module.
    """
    wall = os.path.realpath(directory)
    own_process = f"/proc/{os.getpid()}"

    # Hard links have no path of their own to the directory: they are known by device and number of the file.
    linked = set()
    for folder, _, names in os.walk(wall):
        for name in names:
            about = os.lstat(os.path.join(folder, name))
            if about.st_nlink > 1:
                linked.add((about.st_dev, about.st_ino))

    def refuse_path(path: str, *, opens: bool) -> None:
        if path == wall or path.startswith(wall + os.sep):
            raise PermissionError("below the directory of a blind run: sealed")
        of_a_process = path.startswith("/proc/") and path.split(os.sep)[2].isdigit()
        if of_a_process and path != own_process and not path.startswith(own_process + os.sep):
            raise PermissionError("a blind diagnosis looks into no other process")
        if opens and os.path.isdir(path):
            # An event does not tell the descriptor that its path may be relative to.
            raise PermissionError("a blind diagnosis opens no directory as a descriptor")
        if linked and os.path.exists(path):
            about = os.stat(path)
            if (about.st_dev, about.st_ino) in linked:
                raise PermissionError("a link to a file of a blind run: sealed")

    def reads_only(arguments: tuple[Any, ...]) -> bool:
        """Whether a file or a directory (path, mode, flags) is opened for reading alone.

        A directory that is opened for writing is where an unnamed file is made (O_TMPFILE), as compilers do
        that keep what they compiled: no descriptor of a directory comes of it.
        """
        return bool(arguments[2] & (os.O_WRONLY | os.O_RDWR) == 0)

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if event in _PROCESS_EVENTS:
            raise PermissionError("a blind diagnosis starts no processes")
        if event in _SOCKET_EVENTS:
            raise PermissionError("a blind diagnosis opens no connections")
        # Whatever the event: a list of those that take a path would leave some out.
        for argument in arguments:
            if not isinstance(argument, (str, bytes, os.PathLike)):
                continue
            named = os.fsdecode(argument)
            if named and "\0" not in named:  # else it is no path
                refuse_path(os.path.realpath(named), opens=event == "open" and reads_only(arguments))

    def fork_exec(*_: object) -> NoReturn:
        raise PermissionError("a blind diagnosis starts no processes")

    # `multiprocessing` starts its processes with this function, which raises no event; Windows has none.
    for module in ("_posixsubprocess", "subprocess"):
        for name in ("fork_exec", "_fork_exec"):
            if hasattr(sys.modules.get(module), name):
                setattr(sys.modules[module], name, fork_exec)
    sys.addaudithook(watch)


def diagnose_folder(folder: Path) -> dict[str, Any]:
    """Answer about a case folder with the processor time it took, and the baselines' answers."""
    loaded = load_case(folder)
    start = time.process_time()
    document = document_of(loaded, diagnose(loaded.case))
    document["cpu_s"] = time.process_time() - start
    document["baselines"] = baselines(loaded.case)
    document["baselines_cpu_s"] = time.process_time() - start - document["cpu_s"]
    plain: dict[str, Any] = codec.plain(document)
    return plain


@dataclass(frozen=True)
class BlindCase:
    """A case folder to be diagnosed by a process that is kept out of `sealed`."""

    folder: Path
    sealed: Path
    diagnose: Callable[[Path], dict[str, Any]] = diagnose_folder

    def run(self, report: Report) -> dict[str, Any]:
        """The answer."""
        # Under a neutral path: not even the name of the run is in what is diagnosed.
        room = Path(tempfile.mkdtemp())
        copy = room / self.folder.name
        shutil.copytree(self.folder, copy)
        keep_out(self.sealed)
        try:
            return self.diagnose(copy)
        finally:
            _remove(room)


def _remove(folder: Path) -> None:
    """Delete a folder with all that is in it by paths: `shutil.rmtree` opens directories as descriptors."""
    for place, folders, names in os.walk(folder, topdown=False):
        for name in names:
            os.remove(os.path.join(place, name))
        for name in folders:
            os.rmdir(os.path.join(place, name))
    os.rmdir(folder)


def failed(case: str, reason: str) -> dict[str, Any]:
    """The answer of a case without one: it counts as wrong."""
    nothing: dict[str, Any] = {"effects": [], "combination": [], "gap_after": None}
    return {"case": case, "verdict": "failed", **nothing, "reason": reason}
