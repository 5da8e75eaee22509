"""Usage errors in one line with a suggestion: an unknown command or option, a repeated one, a missing or bad value."""

import contextlib
import dataclasses
import difflib
import io
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ssplat_jax.core.errors import InputError, echo

HELP, VERSION = ("-h", "--help"), "--version"
NAME_INDENT = 4  # of the names of missing options, in the parser's box; help on them is indented by 8


def check_usage(arguments: Sequence[str], commands: Mapping[str, type]) -> None:
    """Checks the name of the command and the names of its options; their values are left to the parser.

    Args:
        arguments: the words after `ssplat`.
        commands: all commands, dataclasses, by name.

    Raises:
        InputError: there is no command, a command or an option that does not exist, or an option twice.
    """
    names = ", ".join(commands)
    if not arguments:
        raise InputError(f"wanted a command ({names}), got none; start with `ssplat demo`, or see `ssplat --help`.")
    name = arguments[0]
    if name == VERSION:
        raise InputError(f"{VERSION}: wanted nothing beside it, got {echo(' '.join(arguments[1:]))}; leave that out.")
    if name in HELP or name.startswith("--tyro-"):
        return
    if name not in commands:
        hint = _nearest(name, commands) or "see `ssplat --help`"
        raise InputError(f"wanted a command ({names}), got {echo(name)}; {hint}.")
    options = [f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(commands[name])]
    given = set()
    for word in arguments[1:]:
        option = word.partition("=")[0].replace("_", "-")
        # A single hyphen may begin a number.
        if option.startswith("--") and option not in (*options, *HELP):
            hint = _nearest(option, options) or f"see `ssplat {name} --help`"
            raise InputError(f"{name}: there is no option {echo(word.partition('=')[0])}; {hint}.")
        if option in options and option in given:  # the parser would take the last one alone
            raise InputError(f"{name}: wanted {option} once, got it twice; list several values behind one.")
        given.add(option)


def parse_in_one_line(parse: Callable[[], Any], name: str) -> Any:
    """Calls `parse`, a parser that prints its complaint in a box and exits with 2; the complaint becomes one line.

    Args:
        parse: the parser.
        name: the command, whose help the line points to.

    Raises:
        InputError: the parser exited with 2.
    """
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return parse()
    except SystemExit as stopped:
        if stopped.code != 2:
            print(box.getvalue(), end="", file=sys.stderr)
            raise
    raise InputError(f"{name}: {_first_part(box.getvalue())}; see `ssplat {name} --help`.")


def _nearest(word: str, known: Mapping[str, type] | Sequence[str]) -> str | None:
    """A suggestion of the known word that looks most like `word`."""
    found = difflib.get_close_matches(word, known, n=1)
    return f"the nearest is {found[0]}" if found else None


def _first_part(box: str) -> str:
    """The complaint in a box, whose parts are what is wrong, help on the argument, and where to read on."""
    lines = [line.strip("│").rstrip() for line in box.splitlines() if line[:1] not in ("╭", "╰")]
    rules = [k for k, line in enumerate(lines) if line.strip() and set(line.strip()) <= set("─-")]
    # The title is a part of its own if the terminal's encoding has no lines to draw.
    begin, end = (0, rules[0]) if box.startswith("╭") else (rules[0] + 1, rules[1])
    problem = textwrap.dedent("\n".join(lines[begin:end])).splitlines()
    if problem[0].startswith("Missing from"):
        names = [line.split() for line in problem[1:] if len(line) - len(line.lstrip()) == NAME_INDENT]
        problem = ["missing " + ", ".join(" ".join(words) for words in names)]
    text = " ".join(" ".join(problem).split()).rstrip(".").removeprefix("Error parsing ")
    return text.replace("invalid literal for int() with base 10:", "wanted a whole number, got").replace(
        "could not convert string to float:", "wanted a number, got"
    )
