"""What a user is told of an error that is theirs to mend, in a sentence in place of a traceback."""

from __future__ import annotations

import difflib
import errno
import re
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.errors import CompactHydraException, InstantiationException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import InterpolationResolutionError, OmegaConfBaseException

from heatsplat.composition import CONF, compose_unresolved, options_of
from heatsplat.errors import SceneError
from heatsplat.io.command_lines import PLAIN, as_dict, config_dirs, setting, typed
from heatsplat.io.settings import walk

# What a disk says that is full, may not be written to, or has a file where a folder is to be: no traceback helps.
NO_PLACE = dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "make room, or give a folder on another disk")
NO_PLACE |= dict.fromkeys((errno.EROFS, errno.EACCES, errno.EPERM), "nothing may be written there: give another folder")
NO_PLACE |= dict.fromkeys(
    (errno.EEXIST, errno.ENOTDIR), "a file is where a folder is to be: remove it, or give another folder"
)
# What OmegaConf says of a resolver of ours that does not take a setting; the key that it names is that of who asked.
RESOLVED = r"ValueError raised while resolving interpolation: ((?:max_steps|ckpt) must be .*)"
# What a command takes where someone typed folders alone.
FOLDERS = {"prepare": "source=FOLDER target=FOLDER"}


def explain(error: Exception, command: str, arguments: Sequence[str]) -> str | None:
    """What is printed of an error that ended a command, or None where it is a mistake of ours, which needs its traceback.

    Args:
        error: of Hydra, which composes and builds, or of a job.
        command: its name, such as "train".
        arguments: what it was given.
    """
    if isinstance(error, CompactHydraException | OmegaConfBaseException):
        return _of_composing(error, command, arguments)
    if "group override must be a string" in str(error) and (nulled := _nulled(arguments)):
        return f"{nulled}=null: a group takes the name of one of its options: {', '.join(options_of(nulled))}"
    if str(error).startswith("Only one of --run, --multirun, --cfg, --info"):  # Hydra's text for a command line
        return "--cfg and --info show one job: leave out -m, and give each setting one value (seed=0, not seed=0,1)"
    cause = expected(error)
    return None if cause is None else sentence(cause)


def expected(error: BaseException) -> BaseException | None:
    """The error behind ``error`` that is the user's to mend and needs no traceback, or None."""
    while error is not None:
        if _of_building(error):  # it says where, and its cause what
            return error
        if isinstance(error, SceneError | FileNotFoundError | ImportError | FloatingPointError):
            return error
        if isinstance(error, OSError) and error.errno in NO_PLACE:
            return error
        if isinstance(error, ValueError) and _raised_here(error):  # of a setting, once the scene is known
            return error
        error = error.__cause__
    return None


def sentence(error: BaseException) -> str:
    """What is printed of an error that is the user's to mend: what it says, without the name of its class."""
    if told := _of_building(error) or _of_resolving(error):
        return told
    if not isinstance(error, OSError) or error.strerror is None:
        return str(error) or type(error).__name__
    told = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    remedy = NO_PLACE.get(error.errno)
    return told if remedy is None else f"{told}; {remedy}"


def _of_composing(error: Exception, command: str, arguments: Sequence[str]) -> str | None:
    """What is printed of an error of Hydra, and of what it built; None for a mistake of ours."""
    if told := _of_building(error) or _of_resolving(error):
        return told
    cause = error.__cause__
    if _place(error) and cause is not None and _raised_here(cause) and expected(cause) is None:
        return None
    meant = _meant(error, command, arguments)
    # Hydra offers to append a key that there is not, which nothing would read.
    told = re.sub(r"\nTo append to your config use \S+", "", str(error)) if meant else str(error)
    return "\n".join(filter(None, [told, str(cause or ""), meant]))


def _of_building(error: BaseException) -> str | None:
    """What is printed where a class did not take its settings; None for other errors."""
    place, cause = _place(error), error.__cause__
    if place and isinstance(cause, ValueError) and not isinstance(cause, SceneError):  # which names the file or the key
        # Most name their setting, such as "normals.views must be ..." of what is built as surroundings.normals.
        named = re.search(rf"\b{re.escape(place.rpartition('.')[2])}[.=]\S", str(cause))
        return str(cause) if named else f"{place}: {cause}"
    if place and isinstance(cause, TypeError) and _of_settings(cause):
        return f"{place}: {cause} (HYDRA_FULL_ERROR=1 shows where)"
    return None


def _of_resolving(error: BaseException) -> str | None:
    """What is printed where a setting is not what others are computed from; None for other errors."""
    told = re.match(RESOLVED, str(error)) if isinstance(error, InterpolationResolutionError) else None
    return told and told[1]


def _place(error: BaseException) -> str | None:
    """Where in the configuration Hydra failed to build a class, such as "density"."""
    found = re.search(r"full_key: (\S+)", str(error)) if isinstance(error, InstantiationException) else None
    return found and found[1]


def _raised_here(error: BaseException) -> bool:
    """Whether code of this package raised an error, and not a library that it called."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return bool(frames) and frames[-1].f_globals.get("__name__", "").startswith("heatsplat.")


def _of_settings(error: TypeError) -> bool:
    """Whether a class or function did not take settings, or a constructor of ours itself stumbled over one."""
    *_, last = (frame for frame, _ in traceback.walk_tb(error.__traceback__))
    called = last.f_globals.get("__name__", "").startswith("hydra.")  # and never entered
    return called or (_raised_here(error) and last.f_code.co_name == "__init__")


def _meant(error: Exception, command: str, arguments: Sequence[str]) -> str:
    """ "Did you mean ...?" for a group's option or a key that there is not, or how a value is written that Hydra cannot read;
    empty where nothing is like it."""
    if isinstance(error, OverrideParseException) and "=" not in error.override:
        return f"Every argument names what it sets: {FOLDERS.get(command, 'key=value')}"
    if isinstance(error, OverrideParseException):
        return _quoted(error.override)
    if ambiguous := re.match(r"Ambiguous value for argument '(.+)'\n", str(error)):
        return _quoted(ambiguous[1])
    if (missing := getattr(error, "missing_cfg_file", None)) and error.options:
        group, _, option = missing.rpartition("/")
        return _did_you_mean([f"{group}={near}" for near in difflib.get_close_matches(option, error.options, 3, 0.5)])
    if unknown := re.search(r"Could not override '([^']+)'", str(error)):
        return _of_unknown_key(unknown[1], command, arguments)
    return ""


def _did_you_mean(near: Sequence[str]) -> str:
    return f"Did you mean {' or '.join(near)}?" if near else ""


def _of_unknown_key(wrong: str, command: str, arguments: Sequence[str]) -> str:
    """Keys like one that there is not, or what stands beside it; empty where nothing is like it."""
    folders, given = config_dirs(arguments)
    others = [text for text in given if not text.startswith(("-", wrong))]
    if folders:  # whose methods and models the command may choose
        others.append(setting("hydra.searchpath", f"file://{folders[0].absolute()}").replace("=", "=[", 1) + "]")
    try:
        settings = OmegaConf.to_container(compose_unresolved(others, command))
    except (CompactHydraException, OmegaConfBaseException):  # it was not the only mistake
        return ""
    if inner := _of_dotted_name(settings, wrong, arguments):
        return inner
    keys = [*(key for key, _ in walk(settings)), *(path.name for path in Path(CONF).iterdir() if path.is_dir())]
    parent, _, leaf = wrong.rpartition(".")
    beside = {
        name: key for key in keys for above, _, name in [key.rpartition(".")] if above == parent and name[0] != "_"
    }
    near = [beside[name] for name in difflib.get_close_matches(leaf, beside, 3)]
    if not near and parent in keys and not beside:
        chosen = f" with {parent}={option}" if (option := as_dict(arguments).get(parent)) else ""
        return f"{parent} has nothing to set{chosen}: leave {wrong} out"
    if not near and parent in keys:
        return f"{parent} has {', '.join(sorted(beside))}"
    meant = _did_you_mean(near or difflib.get_close_matches(wrong, keys, 3))
    return meant or ("" if parent else f"{command} has no such setting; --help lists those that it has")


def _of_dotted_name(settings: dict[str, Any], wrong: str, arguments: Sequence[str]) -> str:
    """How a key is set whose name has dots in it, which a path cannot reach; empty where ``wrong`` looks like none."""
    above, inside, rest = "", settings, wrong
    while isinstance(inside.get(rest.partition(".")[0]), dict):
        first, _, rest = rest.partition(".")
        above, inside = f"{above}.{first}".lstrip("."), inside[first]
    near = difflib.get_close_matches(rest, [name for name in inside if "." in name], 1)
    value = as_dict(arguments).get(wrong, "...")
    return f"{near[0]} is one name, dots and all: {typed(f'{above}={{{near[0]}:{value}}}')}" if near else ""


def _quoted(override: str) -> str:
    """How a setting is written whose value Hydra's grammar does not take as it stands, such as a path with a space."""
    key, _, value = override.partition("=")
    if re.fullmatch(r"[+-]?\d+,\d+", value):
        return (
            f"A number has a decimal point: {key}={value.replace(',', '.')}; two numbers have brackets: {key}=[{value}]"
        )
    if re.fullmatch(r"\[[^][{}'\"]*\]?", value):  # without its end where a shell took it apart at a space
        given = [word.strip() for word in value.strip("[]").split(",") if word.strip()]
        words = [word if PLAIN.fullmatch(word) else setting("", word)[1:] for word in given]
        whole = ",".join([*words, *([] if value.endswith("]") else ["..."])])
        return f"A list is one argument, and text with = or umlauts in it takes quotes: {typed(f'{key}=[{whole}]')}"
    if not value or value[0] in "[{'\"":
        return ""
    return f"Text with spaces, commas, umlauts or brackets takes two pairs of quotes: {typed(setting(key, value))}"


def _nulled(arguments: Sequence[str]) -> str | None:
    """The configuration group that a command line sets to null, if there is one."""
    given = (text.removesuffix("=null") for text in arguments if text.endswith("=null"))
    return next((group for group in given if options_of(group)), None)
