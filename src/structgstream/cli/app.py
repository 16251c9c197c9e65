# SPDX-License-Identifier: Apache-2.0
"""Finds the command, runs it, and turns what goes wrong into one sentence and an exit status.

Only the standard library is imported here, so that ``structgstream --help`` answers at once.
"""

import difflib
import importlib
import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType

from structgstream.errors import ConfigError, StructGStreamError

COMMANDS = {
    "demo": "reconstruct the bundled clip and show everything there is to see",
    "reconstruct": "turn a capture into a stream, frame by frame",
    "evaluate": "score a stream against the cameras that training did not see",
    "play": "show a stream in the browser, from any angle",
    "render": "render a camera or a camera path to mp4 or PNG",
    "export": "write a page with a player, or frames as plain 3D Gaussians: .ply, .splat, .spz",
    "inspect": "show what a stream file holds",
    "doctor": "show what this machine has, what is missing, and how to mend it",
}
ENTRY_POINTS = "structgstream.commands"
"""What other distributions call their packages of commands: with ``COMMANDS`` and, for each, a module with ``main``."""
STUDIES = ("ablate", "compare")
"""Commands of the distribution structgstream-studies, which not everybody installs."""
DONE, PROBLEM, USAGE, INTERRUPTED = 0, 1, 2, 130


class UsageError(Exception):
    """The command line asks for something that does not exist or does not go together."""


class Interrupted(Exception):
    """The user pressed Ctrl-C; the message says what is stored and how to go on."""


@contextmanager
def usage_checked() -> Iterator[None]:
    """What the options ask for is checked here: a value that cannot work is wrong usage.

    Raises:
        UsageError: in place of a ``ConfigError``.
    """
    try:
        yield
    except ConfigError as error:
        raise UsageError(str(error)) from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; the exit status is 0 done, 1 a problem, 2 wrong usage, 130 interrupted."""
    # Two threads that spin while they wait for each other are slower than one on a machine that does anything else.
    # OpenMP reads this once, when torch is loaded, so it is set before any command imports it.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    given = list(sys.argv[1:] if arguments is None else arguments)
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
    except SystemExit as ending:  # the parser's own, after it has printed help or what is wrong
        return ending.code if isinstance(ending.code, int) else DONE if ending.code is None else PROBLEM
    except UsageError as error:
        _say(f"structgstream: {error}")
        return USAGE
    except (KeyboardInterrupt, Interrupted) as error:
        _say(f"\nInterrupted. {error}".rstrip())
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output left (`| head`). Python would complain again while it closes stdout.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PROBLEM
    except StructGStreamError as error:
        if debug:
            traceback.print_exc()
        _say(f"structgstream: {error}")
        return PROBLEM
    except MemoryError as error:
        if debug:
            traceback.print_exc()
        said = f" ({error})" if str(error) else ""
        _say(f"structgstream: not enough memory{said}; close other programs, or use smaller pictures (--scale 0.5).")
        return PROBLEM
    except Exception as error:
        if debug:
            traceback.print_exc()
        _say(
            f"structgstream: an error that should not happen, {type(error).__name__}: {error}. "
            "Run the command again with --debug and report what it prints."
        )
        return PROBLEM
    return DONE


def overview() -> str:
    """The text of ``structgstream --help``."""
    further = {name: text for package in _packages() for name, text in package.COMMANDS.items()}
    commands = "\n".join(f"  {name:<12} {text}" for name, text in {**COMMANDS, **further}.items())
    return f"""usage: structgstream COMMAND [options]

A ring of synchronised cameras to a free-viewpoint video stream, frame by frame.

commands:
{commands}

options:
  -h, --help   this text; after a command, its options
  --version    the version
  --debug      with any command: show the traceback of an error

examples:
  structgstream demo
  structgstream reconstruct basketball -o ball.sgs --held-out 0 10 15 30
  structgstream play ball.sgs --capture basketball
  structgstream evaluate ball.sgs basketball --report ball-report
  structgstream render ball.sgs --path orbit -o ball.mp4"""


def _run(command: str, arguments: list[str]) -> None:
    homes = dict.fromkeys(COMMANDS, "structgstream.cli")
    if command not in homes:
        homes |= {name: package.__name__ for package in _packages() for name in package.COMMANDS}
    if command not in homes and command in STUDIES:
        raise UsageError(
            f"the command {command!r} is one of structgstream-studies, which is not installed; "
            "install it with: pip install ./studies (in the repository of structgstream)"
        )
    if command not in homes:
        near = difflib.get_close_matches(command, homes, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise UsageError(f"there is no command {command!r}.{hint} Commands: {', '.join(homes)}.")
    importlib.import_module(f"{homes[command]}.{command}").main(arguments)


def _packages() -> list[ModuleType]:
    """Packages of commands that other distributions bring."""
    from importlib.metadata import entry_points

    return [point.load() for point in entry_points(group=ENTRY_POINTS)]


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
