"""Command lines: flags out of a dataclass, and one clear line for whatever a user gets wrong."""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import errno
import os
import sys
import types
import typing

MESSAGE = 4000  # characters of the longest message; more is cut out of its middle


class UserError(Exception):
    """Bad input from outside. The message names the file, flag or value, and what would have been valid.

    It is one line, and printable: what a damaged file holds reaches the terminal as text.
    Test      tests/plumbing/test_runs.py::test_user_error_is_one_line
    """

    def __init__(self, message):
        text = printable(" ".join(str(message).split()))
        if len(text) > MESSAGE:
            text = f"{text[: MESSAGE * 3 // 4]} … {text[-MESSAGE // 4 + 3 :]}"
        super().__init__(text)


def printable(text) -> str:
    """Text with control characters and the like escaped.

    Test      tests/plumbing/test_runs.py::test_user_error_is_one_line"""
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def complain(lines) -> int:
    """Name on stderr what of many files cannot be used, when the rest is done.  -> exit status: 1 if there is any

    Test      tests/headset/test_stream.py::test_folder_of_recordings"""
    for line in lines:
        print(f"error: {line}", file=sys.stderr)
    return int(bool(lines))


def run_main(main_fn, argv=None):
    """Call main_fn(argv), then exit: its own int; 2 and one line for a UserError, too little memory or a name of a
    file that no system takes; 130 on Ctrl-C.

    Test      tests/plumbing/test_runs.py::test_run_main
    """
    try:
        code = main_fn(sys.argv[1:] if argv is None else argv)
        sys.stdout.flush()
    except BrokenPipeError:  # as in `… | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        code = 141  # what a shell calls SIGPIPE
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        code = 2
    except MemoryError as error:
        print(f"error: not enough memory: {printable(str(error))[:MESSAGE]}; give smaller numbers", file=sys.stderr)
        code = 2
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:  # any other is for whoever opens the file
            raise
        print(f"error: {printable(str(error.filename))[:60]}…: {error.strerror}; give a shorter one", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        code = 130
    sys.exit(code if isinstance(code, int) else 0)


# ---- command line ---------------------------------------------------------------------------------------------------

HUGE = 1e18  # NumPy has no integers above 2**63; also refuses infinity, and NaN fails every comparison
POSITIVE = (lambda v: 0 < v < HUGE, "greater than 0 and below 1e18")
NONNEGATIVE = (lambda v: 0 <= v < HUGE, "0 or greater, and below 1e18")
UNIT = (lambda v: 0 <= v <= 1, "from 0 to 1")
COUNT = (lambda v: 1 <= v <= 10**6, "from 1 to 1000000")
PNG = (lambda v: v.lower().endswith(".png"), "a name that ends in .png")
THREADS = (lambda v: 0 <= v <= 1024, "from 0 to 1024")
ALL_POSITIVE = (lambda v: len(v) > 0 and all(x > 0 for x in v), "one or more numbers greater than 0, as in 256,128")


def some_of(names):
    """The check of a tuple of names.  Test: tests/test_ppo.py::test_recipe"""
    return (lambda v: set(v) <= set(names)), f"one or several of {', '.join(names)}"


def arg(default, help, choices=None, flag=None, check=None, metavar=None):
    """Declare one dataclass field that is also a command-line flag.

    Args      default : value; None needs an annotation such as `int | None`
              help : str; choices : valid values, or None for any; metavar : str shown in --help
              flag : "--x"; by default the field's name with dashes
              check : (test, text), where test(value) -> bool and text is the valid range, e.g. POSITIVE
    Returns   dataclasses.field
    Test      tests/plumbing/test_runs.py::test_cli_reads_every_kind
    """
    settings = {"help": help, "choices": choices, "flag": flag, "check": check, "metavar": metavar}
    return dataclasses.field(default=default, metadata=settings)


def cli(dataclass_type, argv, prog, description):
    """Parse argv into one instance of dataclass_type, whose fields are declared with `arg`.

    `learning_rate` is read from --learning-rate or --learning_rate, a bool from --x or --no-x, a tuple from 256,128;
    an integer may be written 1e6, and an optional value `none`. --help prints every default.

    Args      dataclass_type : class; argv : list of str; prog, description : str
    Returns   dataclass_type
    Raises    SystemExit: 0 after --help; 2 after one line about an unknown flag or a bad value
    Test      tests/plumbing/test_runs.py::test_cli_reads_every_kind, test_cli_refuses
    """
    raw = argparse.RawDescriptionHelpFormatter  # the commands of a module's first lines stay lines
    parser = argparse.ArgumentParser(prog=prog, description=description, allow_abbrev=False, formatter_class=raw)
    parser.error = lambda message: parser.exit(2, f"{prog}: error: {message} (see --help)\n")
    hints, fields = typing.get_type_hints(dataclass_type), dataclasses.fields(dataclass_type)
    flags = {f.name: f.metadata.get("flag") or "--" + f.name.replace("_", "-") for f in fields}
    for f in fields:
        if f.default is dataclasses.MISSING:
            raise TypeError(f"{dataclass_type.__name__}.{f.name} needs a default: declare it with arg(default, help)")
        read, choices = _reader(hints[f.name]), f.metadata.get("choices")
        if read is bool:
            how = {"action": argparse.BooleanOptionalAction}
        else:
            how = {"type": read, "choices": choices}
            how["metavar"] = f.metadata.get("metavar") or (None if choices else read.__name__.upper())
        action = parser.add_argument(flags[f.name], dest=f.name, default=f.default, **how)
        action.help = f"{f.metadata.get('help', '')} (default: {_shown(f.default)})".replace("%", "%%")
    argv = [_dashed(a) for a in argv]
    values, unknown = parser.parse_known_args(argv)
    if unknown:
        near = difflib.get_close_matches(unknown[0].split("=")[0], list(parser._option_string_actions), 1)
        parser.error(f"unknown argument {unknown[0]}" + (f"; did you mean {near[0]}?" if near else ""))
    for f in fields:
        check, value = f.metadata.get("check"), getattr(values, f.name)
        if check and value is not None and not check[0](value):
            parser.error(f"argument {flags[f.name]}: {_shown(value)} is not valid; it must be {check[1]}")
    return dataclass_type(**vars(values))


def words_first(argv) -> tuple[list, list]:
    """A command line's words before its first flag, and the rest.

    Test      tests/extras/test_policies.py::test_wrong_commands, tests/extras/test_arms.py::test_wrong_commands"""
    argv = list(argv or [])
    n = next((k for k, a in enumerate(argv) if a.startswith("-")), len(argv))
    return argv[:n], argv[n:]


def given_flags(argv) -> set:
    """Names of the fields whose flags are on a command line, whatever their values.

    Test      tests/test_ppo.py::test_resume_refuses_other_options,
              tests/skeletal/test_skeletal_play.py::test_interrupt"""
    return {a.split("=")[0].lstrip("-").replace("-", "_") for a in argv if a.startswith("--")}


def _dashed(a):
    """--some_flag=a_b -> --some-flag=a_b; anything else unchanged."""
    name, equals, value = a.partition("=")
    return name.replace("_", "-") + equals + value if a.startswith("--") else a


def _shown(value):
    """A value as it would be typed on the command line."""
    if isinstance(value, tuple | list):
        return ",".join(str(v) for v in value)
    return "none" if value is None else str(value)


def _reader(hint):
    """The function that reads one flag's text, from the field's annotation."""
    optional = False
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        optional = True
        hint = next(a for a in typing.get_args(hint) if a is not type(None))
    if hint is bool:
        return bool
    inner = typing.get_args(hint)[0] if typing.get_origin(hint) in (tuple, list) else hint
    many = inner is not hint or hint is tuple
    inner = int if inner is tuple else inner

    def read(text):
        if optional and text.lower() == "none":
            return None
        if many:
            return tuple(_number(inner, part.strip()) for part in text.split(",") if part.strip())
        return _number(hint, text)

    read.__name__ = ("comma-separated " if many else "") + getattr(inner, "__name__", "str").lower()
    return read


def _number(kind, text):
    """kind(text), where an int may also be written 1e6."""
    if kind is int:
        try:
            return int(text)
        except ValueError:
            if float(text).is_integer():
                return int(float(text))
            raise
    return kind(text)


def markdown(rows) -> str:
    """Rows of text as a Markdown table, the first the heading.  Test: tests/test_metrics.py::test_table"""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    lines.insert(1, "|---" * len(rows[0]) + "|")
    return "\n".join(lines)


def cell(value, fmt) -> str:
    """A number as text: a dash for NaN, `never` for infinity.  Test: tests/test_metrics.py::test_table"""
    return "-" if value != value else "never" if value == float("inf") else fmt.format(value)
