"""Cases in processes of their own: what is sent there, and what comes back."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

from workflow.diagnose.case_files import LoadedCase
from workflow.diagnose.outputs import Engine, Options, files_of
from workflow.engine.errors import InputError, StageError, one_line
from workflow.engine.executor import Report


@dataclass(frozen=True, eq=False)
class Finished:
    """Files by name, or why there are none; bad_input: the failure is about what the user gave. cpu_s: of the
    process so far."""

    files: Mapping[str, bytes]
    cpu_s: float
    failure: str | None = None
    bad_input: bool = False


@dataclass(frozen=True, eq=False)
class Work:
    """One case to do."""

    loaded: LoadedCase
    options: Options
    code_sha256: str
    engine: Engine

    def run(self, report: Report) -> Finished:
        """The case, here; whatever goes wrong is said in one line."""
        try:
            files = files_of(self.loaded, self.options, self.code_sha256, engine=self.engine, report=report)
        except InputError as error:
            return Finished({}, time.process_time(), str(error), bad_input=True)
        except StageError as error:
            return self.failed(str(error))
        except Exception as error:
            return self.failed(f"internal error: {type(error).__name__}: {one_line(error)}")
        return Finished(files, time.process_time())

    def failed(self, reason: str) -> Finished:
        return Finished({}, time.process_time(), reason)
