# SPDX-License-Identifier: Apache-2.0
"""Finds the command, runs it, and reports errors as one sentence and an exit status.

Only the standard library is imported here, so that ``structgstream --help`` is fast.
"""

import difflib
import errno
import gc
import importlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType, ModuleType
from typing import Any

from structgstream.errors import ConfigError, OutOfMemoryError, StructGStreamError

COMMANDS = {
    "demo": "reconstruct, evaluate and export the bundled clip",
    "prepare": "turn videos of your own cameras into a calibrated capture, and check it",
    "board": "write a calibration board to print",
    "reconstruct": "turn a capture into a stream, frame by frame",
    "track": "follow what moves through a capture, so that groups of frames can be fitted separately",
    "fit-group": "fit one group of frames, from a header and a track",
    "join": "join groups of frames that were fitted separately to one stream",
    "parallel": "turn a capture into a stream, groups of frames side by side, on one machine or many",
    "plan": "how long a capture would take, on how many machines, and how many bytes it would be",
    "evaluate": "score a stream against the held-out cameras",
    "play": "show a stream in the browser, from any angle",
    "serve": "serve a folder of streams to viewers, live ones while they are reconstructed",
    "token": "make an access token for a served stream",
    "render": "render a camera or a camera path to mp4 or PNG",
    "export": "write a page with a player, or frames as plain 3D Gaussians: .ply, .spz, .sog, .glb, .usd ...",
    "import": "make a stream of a numbered .ply sequence of another trainer",
    "archive": "turn a folder of segments into one stream file",
    "add-sound": "store sound with a stream that was made without it",
    "inspect": "show the content of a stream file",
    "doctor": "show available back-ends and packages, and how to install missing ones",
}
SHARED = {
    "add-sound": "conversion.add_sound",
    "archive": "conversion.archive",
    "board": "prepare.board",
    "export": "conversion.export",
    "fit-group": "groups.fit_group",
    "import": "conversion.import_files",
    "join": "groups.join",
    "plan": "parallel.plan",
    "play": "serve.play",
    "token": "serve.token",
    "track": "groups.track",
}
"""Module and function of the commands that share a module; each of the others is ``main`` of the module of its name."""
ENTRY_POINTS = "structgstream.commands"
"""Entry-point group for other distributions' commands: packages with ``COMMANDS`` and a module with ``main`` each."""
DONE, PROBLEM, USAGE, INTERRUPTED, TERMINATED = 0, 1, 2, 130, 143


class UsageError(Exception):
    """The command line has an unknown or contradictory option."""


class Interrupted(Exception):
    """The user pressed Ctrl-C; the message states what is stored and how to continue."""


@contextmanager
def interruption(message: Callable[[], str]) -> Iterator[None]:
    """Gives Ctrl-C and SIGTERM in the block a message: what is stored and how to continue.

    Raises:
        Interrupted: the user pressed Ctrl-C.
        Terminated: SIGTERM came.
    """
    try:
        yield
    except KeyboardInterrupt as error:
        raise (Terminated if isinstance(error, Terminated) else Interrupted)(message()) from None


@contextmanager
def usage_errors() -> Iterator[None]:
    """Converts ``ConfigError`` to ``UsageError`` while options are checked.

    Raises:
        UsageError: in place of a ``ConfigError``.
    """
    try:
        yield
    except ConfigError as error:
        raise UsageError(str(error)) from None


def program() -> int:
    """:func:`main` in a process of its own.

    Importing torch allocates 200,000 objects that live on. To search them for cycles again and again, and once more at
    the end, takes a third of a short command.
    """
    gc.set_threshold(50_000, 20, 20)
    try:
        return main()
    finally:
        gc.freeze()


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit status: 0 done, 1 an error, 2 wrong usage, 130 Ctrl-C, 143 SIGTERM."""
    # Spinning OpenMP threads slow each other down on a machine with other load. OpenMP reads this once, when torch is
    # loaded, so it is set before any command imports it.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    given = list(sys.argv[1:] if arguments is None else arguments)
    # OpenCV's threads spin, too, after every call, and here its calls are small. Only `prepare` gives it large ones.
    if given[:1] != ["prepare"]:
        os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")
    debug = "--debug" in given
    given = [argument for argument in given if argument != "--debug"]
    if not given or given[0] in ("-h", "--help"):
        print(overview(), file=sys.stdout if given else sys.stderr)
        return DONE if given else USAGE
    if given[0] == "--version":
        from structgstream.version import __version__

        print(__version__)
        return DONE
    try:
        _run(given[0], given[1:])
    except SystemExit as exit_:  # from the parser, after it has printed help or an error
        return exit_.code if isinstance(exit_.code, int) else DONE if exit_.code is None else PROBLEM
    except UsageError as error:
        _print_error(f"structgstream: {error}")
        return USAGE
    except Terminated as error:
        _print_error(f"\nTerminated. {error}")
        return TERMINATED
    except (KeyboardInterrupt, Interrupted) as error:
        _print_error(f"\nInterrupted. {error}".rstrip())
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output has exited (`| head`). Python would raise again while it closes stdout.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PROBLEM
    except Exception as error:
        if debug:
            traceback.print_exc()
        _print_error(f"structgstream: {_sentence(error)}")
        return PROBLEM
    return DONE


def _sentence(error: Exception) -> str:
    """What an error says to the user: one of this package, of the operating system, or an unexpected one."""
    if isinstance(error, StructGStreamError):
        return str(error)
    if isinstance(error, PermissionError) and error.filename is not None:
        return f"no permission for {error.filename}; change its permissions or its owner, or use another place."
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        where = "" if error.filename is None else f" of {error.filename}"
        return f"the disk{where} is full ({error.strerror}); make room, and run the command again."
    if type(error).__name__ == "OutOfMemoryError":  # torch's, which takes a second to import.
        return str(OutOfMemoryError("on the GPU", on_gpu=True))
    if isinstance(error, MemoryError):
        detail = f" ({error})" if str(error) else ""
        return f"not enough memory{detail}; close other programs, or use smaller pictures (--scale 0.5)."
    return (
        f"unexpected error, {type(error).__name__}: {error}. Run the command again with --debug and report the output."
    )


def overview() -> str:
    """The text of ``structgstream --help``."""
    further = {name: text for package in _packages() for name, text in package.COMMANDS.items()}
    commands = "\n".join(f"  {name:<12} {text}" for name, text in {**COMMANDS, **further}.items())
    return f"""usage: structgstream COMMAND [options]

Free-viewpoint video streams from synchronised cameras, reconstructed frame by frame.

commands:
{commands}

options:
  -h, --help   this text; after a command, its options
  --version    the version
  --debug      with any command: show the traceback of an error

examples:
  structgstream demo
  structgstream prepare videos -o capture --held-out auto
  structgstream reconstruct basketball -o ball.sgs --held-out 0 10 15 30
  structgstream play ball.sgs --capture basketball
  structgstream evaluate ball.sgs basketball --report ball-report
  structgstream render ball.sgs --path orbit -o ball.mp4"""


def _run(command: str, arguments: list[str]) -> None:
    packages = dict.fromkeys(COMMANDS, "structgstream.cli")
    if command not in packages:
        packages |= {name: package.__name__ for package in _packages() for name in package.COMMANDS}
    if command not in packages:
        near = difflib.get_close_matches(command, packages, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise UsageError(f"there is no command {command!r}.{hint} Commands: {', '.join(packages)}.")
    entry_of(command, packages[command])(arguments)


def entry_of(command: str, package: str = "structgstream.cli") -> Callable[[list[str]], None]:
    """The function of a command of a package of commands."""
    usual = f"{command.replace('-', '_')}.main"
    module, function = (SHARED.get(command, usual) if package == "structgstream.cli" else usual).split(".")
    return getattr(importlib.import_module(f"{package}.{module}"), function)


def _packages() -> list[ModuleType]:
    """Packages of commands of other distributions."""
    from importlib.metadata import entry_points

    return [point.load() for point in entry_points(group=ENTRY_POINTS)]


def _print_error(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class Terminated(KeyboardInterrupt):
    """The process was asked to end, as by Ctrl-C; the message states what is stored and how to continue."""


class StopSignal:
    """Within its ``with`` block the first SIGTERM, or the first Ctrl-C, only sets :attr:`asked`; a second one raises
    Terminated or KeyboardInterrupt at once.

    At the first one the signal's handler calls ``on_ask``, to wake what waits for frames. Only the main thread receives
    signals, so elsewhere the block changes nothing.
    """

    def __init__(self, on_ask: Callable[[], object] = lambda: None, *, number: signal.Signals = signal.SIGTERM) -> None:
        self.asked = False
        self._on_ask, self._number = on_ask, number
        self._before: Any = None

    def __enter__(self) -> "StopSignal":
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(self._number, self._handle)
        return self

    def __exit__(self, *raised: object) -> None:
        if self._before is not None:
            signal.signal(self._number, self._before)

    def end(self, *, whole: bool) -> None:
        """Must be called between frames. Raises Terminated or KeyboardInterrupt, which ends the block, if a signal has
        come and the run is not ``whole``, that is, complete."""
        if self.asked and not whole:
            raise Terminated if self._number == signal.SIGTERM else KeyboardInterrupt

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise Terminated("The frame being fitted was given up.") if number == signal.SIGTERM else KeyboardInterrupt
        self.asked = True
        self._on_ask()
        if number == signal.SIGINT:
            _print_error("Ends after this frame; Ctrl-C again ends at once.")


@contextmanager
def interruptible(*, again_seconds: float = 3.0) -> Iterator[None]:
    """Within this block Ctrl-C is a ``KeyboardInterrupt`` that leaves it.

    Libraries can lose the exception: one that is being imported converts it to its own error (pycolmap does), and a
    callback from C drops it. So any error after Ctrl-C counts as Ctrl-C, and a block that continues is interrupted
    again every ``again_seconds``. Cleanup code is interrupted again, too, so use it only for work whose results are
    written completely or not at all. Outside of the main thread, and where Ctrl-C is ignored (``nohup``), the block
    changes nothing.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    asked = False

    def interrupted(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        signal.setitimer(signal.ITIMER_REAL, again_seconds, again_seconds)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupted)
    alarm = signal.signal(signal.SIGALRM, interrupted)
    try:
        yield
    except Exception as error:
        if not asked:
            raise
        raise KeyboardInterrupt from error
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGINT, before)
        signal.signal(signal.SIGALRM, alarm)
    if asked:
        raise KeyboardInterrupt
