"""`flexlink tune`: a page on this machine, with sliders for the specification.

The server listens on the loopback address only. A page of another site may know the port: every request
needs the token of the page's address, as a header that browsers send to their own origin only, and names
this server as its host (a name that somebody points to 127.0.0.1 is another).
"""

from __future__ import annotations

import json
import re
import secrets
import sys
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from workflow.config.design_file import DesignFile
from workflow.config.run_config import built_in_config
from workflow.engine.documents import json_object
from workflow.engine.errors import InputError, one_line
from workflow.engine.progress import Progress
from workflow.tasks.pipeline import identify_only
from workflow.text.templates import environment
from workflow.tune.session import Handler, SupersededError, TuningSession

# Loopback address: nobody outside this machine reaches it.
HOST = "127.0.0.1"
# Of a request, bytes: its settings are a page of text. Large enough for all of them, small enough to be read
# into memory by anybody who knows the token.
_MOST_BYTES = 1 << 16
# Of a Content-Length: Python reads no integer of more than 4300 digits, and `str.isdigit` is true of digits
# that `int` does not read, like a superscript two.
_LENGTH = re.compile(r"[0-9]{1,20}")


class TuneServer(ThreadingHTTPServer):
    """Serves one session; `url` is the page's address with its token."""

    daemon_threads = True

    def __init__(self, session: TuningSession, port: int = 0) -> None:
        try:
            super().__init__((HOST, port), _Request)
        except (OSError, OverflowError) as error:
            raise InputError(f"--port {port}: cannot be listened on ({error}); choose another") from error
        self.session = session
        # Other pages in the same browser, and other users of the machine, do not know it.
        self.token = secrets.token_urlsafe(24)
        self.hosts = tuple(f"{name}:{self.server_port}" for name in (HOST, "localhost"))
        self.actions: dict[str, Handler] = {
            "/scaled": lambda asked: session.scaled(asked["settings"]),
            "/near": lambda asked: session.near(asked["settings"]),
            "/design": lambda asked: session.design(asked["settings"]),
            "/bound": lambda asked: session.bound(asked["settings"]),
            "/save": lambda asked: session.save(asked["settings"], asked["name"]),
        }

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.server_port}/?token={self.token}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """One line on the terminal, never a traceback; nothing where whoever asked has left."""
        error = sys.exc_info()[1]
        if error is not None and not isinstance(error, OSError):
            sys.stderr.write(f"flexlink tune: {type(error).__name__}: {one_line(error)}\n")

    def page(self, nonce: str) -> str:
        """The page as HTML.

        nonce: of its scripts, as the policy in the head of the answer has it: no other script runs.
        """
        session = self.session
        settings = _of_script(session.settings())
        unit = session.output_unit
        # What has several numbers is no slider: the page names it as fixed.
        stated = session.specification.model_dump(exclude_none=True)
        fixed = [name for name, value in stated.items() if isinstance(value, dict | tuple)]
        plants = ", ".join(path.stem for path in session.paths)
        template = environment().get_template("tune.html.j2")
        return template.render(
            title=f"Tune {plants}",
            settings=settings,
            nonce=nonce,
            fixed=fixed,
            step=session.step_words,
            step_size=session.step_size,
            unit=_of_script(f" [{unit}]" if unit else ""),
            filtered=session.filter is not None,
            out=session.out,
            name=_free_name(session.out),
        )


def _free_name(folder: Path) -> str:
    """First of "tuned-1", "tuned-2", ... that does not exist in a folder."""
    number = 1
    while (folder / f"tuned-{number}").exists():
        number += 1
    return f"tuned-{number}"


def _of_script(value: Any) -> str:
    """A value as JSON that may stand in a script of a page: no tag begins or ends in it."""
    return json.dumps(value).replace("<", "\\u003c")


class _Request(BaseHTTPRequestHandler):
    server: TuneServer
    protocol_version = "HTTP/1.1"
    timeout = 60
    server_version = "flexlink"
    sys_version = ""

    def do_GET(self) -> None:
        try:
            asked = urlsplit(self.path)
        except ValueError as error:  # http://[ is the beginning of no address
            self._refuse(HTTPStatus.BAD_REQUEST, one_line(error))
            return
        token = (parse_qs(asked.query).get("token") or [""])[0]
        if asked.path != "/":
            self._refuse(HTTPStatus.NOT_FOUND, "no such page")
        elif self._allowed(token):
            # Only the script of this very answer may run.
            nonce = secrets.token_urlsafe(16)
            self._answer(HTTPStatus.OK, self.server.page(nonce), "text/html", nonce)

    def do_POST(self) -> None:
        if not self._allowed(self.headers.get("X-Flexlink-Token", "")):
            return
        action = self.server.actions.get(self.path)
        if action is None:
            self._refuse(HTTPStatus.NOT_FOUND, "no such action")
            return
        # How long the content is has to be known before it is read, and said once: of two lengths, or a
        # length and pieces, the rest of the content would be taken for the next request.
        lengths = self.headers.get_all("Content-Length", [])
        if not lengths:
            self._refuse(HTTPStatus.LENGTH_REQUIRED, "expected a Content-Length")
            return
        in_pieces = "Transfer-Encoding" in self.headers
        if len(lengths) > 1 or in_pieces or not _LENGTH.fullmatch(lengths[0]):
            self._refuse(HTTPStatus.BAD_REQUEST, "expected one Content-Length, a whole number of bytes")
            return
        length = int(lengths[0])
        if length > _MOST_BYTES:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected at most {_MOST_BYTES} bytes")
            return
        self._act(action, self.rfile.read(length))

    def _act(self, action: Handler, content: bytes) -> None:
        try:
            answer = json.dumps(action({"name": "", **_request(content)}), allow_nan=False)
        except SupersededError:
            self._refuse(HTTPStatus.CONFLICT, "superseded")
        except InputError as error:
            self._refuse(HTTPStatus.BAD_REQUEST, one_line(error))
        except Exception as error:  # the page goes on, whatever a library raises
            reason = f"internal error: {type(error).__name__}: {one_line(error)}"
            self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, reason)
        else:
            self._answer(HTTPStatus.OK, answer, "application/json")

    def _allowed(self, token: str) -> bool:
        """Whether the request comes from our own page; refused where not."""
        origin = self.headers.get("Origin")
        ours = self.headers.get("Host", "") in self.server.hosts
        ours &= origin is None or origin in {f"http://{host}" for host in self.server.hosts}
        if ours and secrets.compare_digest(token.encode(), self.server.token.encode()):
            return True
        self._refuse(HTTPStatus.FORBIDDEN, "open the address that flexlink tune printed, token included")
        return False

    def _refuse(self, status: HTTPStatus, said: str) -> None:
        # Its content may not have been read.
        self.close_connection = True
        self._answer(status, json.dumps({"error": said}), "application/json")

    def _answer(self, status: HTTPStatus, text: str, kind: str, nonce: str = "") -> None:
        content = text.encode()
        policy = "default-src 'none'; style-src 'unsafe-inline'; connect-src 'self'; img-src data:; "
        policy += f"base-uri 'none'; form-action 'none'; frame-ancestors 'none'; script-src 'nonce-{nonce}'"
        self.send_response(status)
        headers = {
            "Content-Type": f"{kind}; charset=utf-8",
            "Content-Length": str(len(content)),
            "Content-Security-Policy": policy,
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }
        if self.close_connection:
            headers["Connection"] = "close"
        for name, value in headers.items():
            self.send_header(name, value)
        try:
            self.end_headers()
            self.wfile.write(content)
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True  # whoever asked has left

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Nothing: the terminal has the address and errors only."""


def _request(content: bytes) -> dict[str, Any]:
    """What is asked for: an object with `settings`, all of its numbers finite.

    Raises InputError, one line, for anything else.
    """
    source = "the request"
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{source}: {one_line(error)}") from error
    asked = json_object(text, source)
    if not isinstance(asked.get("settings"), dict):
        raise InputError(f"{source}: expected a JSON object with settings")
    try:
        json.dumps(asked, allow_nan=False)
    except ValueError as error:  # NaN, Infinity, or 1e999, which Python's reader takes
        raise InputError(f"{source}: expected finite numbers") from error
    return asked


@contextmanager
def tuning(
    paths: Sequence[Path],
    file: DesignFile | None,
    *,
    out: Path,
    seed: int,
    port: int = 0,
    progress: Progress | None = None,
) -> Iterator[TuneServer]:
    """A server for these plants (none: the built-in arm, identified into `out`), not serving yet."""
    if not paths:
        paths = [out / "default_arm"]
        config, text = built_in_config()
        identify_only(config, paths[0], config_text=text, progress=progress)
    server = TuneServer(TuningSession(paths, file or DesignFile(), out, seed), port)
    try:
        yield server
    finally:
        server.session.cancel()
        server.server_close()


def serve(server: TuneServer, tell: Callable[[str], None], *, browser: bool) -> None:
    """Say the address and serve until Ctrl-C, which is no error."""
    try:
        tell(server.url)
        if browser:
            webbrowser.open(server.url)
        # So soon Ctrl-C is heard [s].
        server.serve_forever(poll_interval=0.2)
    except KeyboardInterrupt:
        tell("stopped")
