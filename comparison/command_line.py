"""Parts of both commands: key=value options, variants and integrators by name, one-line error messages."""

import re
import sys
import tempfile
import traceback
from argparse import ArgumentTypeError
from importlib import metadata
from pathlib import Path

import mitsuba as mi

from .interruption import interruptions_kept


class UsageError(Exception):
    """Invalid use of the command, with a message for the user. Exit status 2."""


def value(text):
    """Convert the text of a parameter to a bool (`true`, `false`), an int or a float, if possible."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def definition(text):
    """Split `key=value`; an argparse type."""
    key, separator, content = text.partition("=")
    if not separator or not key:
        raise ArgumentTypeError(f"'{text}' is not of the form key=value")
    return key, content


def parameter(text):
    """Split `key=value` and convert the value (see `value`); an argparse type."""
    key, content = definition(text)
    return key, value(content)


def positive(kind):
    """Return an argparse type for positive numbers of a kind (int or float)."""

    def convert(text):
        try:
            number = kind(text)
        except ValueError:
            number = 0
        if not 0 < number < float("inf"):
            raise ArgumentTypeError(f"'{text}' is not a positive {'whole ' if kind is int else ''}number")
        return number

    return convert


def seed(text):
    """Convert the text of a seed, 0 to 2^32 - 1; an argparse type."""
    if not text.isdecimal() or int(text) >= 2**32:
        raise ArgumentTypeError(f"'{text}' is not a whole number from 0 to 4294967295")
    return int(text)


def add_common_options(parser):
    """Add the options of both commands."""
    parser.add_argument(
        "-D", "--define", action="append", type=definition, default=[], metavar="KEY=VALUE",
        help="define the parameter $KEY of the scene; repeatable",
    )  # fmt: skip
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb", metavar="VARIANT", help="variant (default: llvm_ad_rgb)")
    parser.add_argument("-t", "--threads", type=positive(int), metavar="N", help="number of threads (default: all)")
    parser.add_argument("-v", "--verbose", action="store_true", help="log more, and show tracebacks of errors")


def set_variant(name):
    """Set a variant, for which this project's integrators are registered. Raises UsageError if it is not available."""
    if name not in mi.variants():
        raise UsageError(f"unknown variant '{name}'; there are {', '.join(mi.variants())}")
    try:
        mi.set_variant(name)
    except ImportError as error:  # Dr.Jit finds no driver
        if not name.startswith("cuda_"):
            raise
        raise UsageError(
            f"the variant '{name}' needs an NVIDIA GPU and its driver, which Dr.Jit does not find; without them choose "
            f"a variant llvm_*, such as llvm_ad_rgb ({error})"
        ) from None
    import integrators  # noqa: F401 (registers plugins; needs a variant)


def own_integrators():
    """Return the names of this project's integrators."""
    import integrators

    return integrators.PLUGINS


def check_integrator(name):
    """Raise UsageError with the list of integrators if none has the given name."""
    try:
        mi.PluginManager.instance().create_object(mi.Properties(name))
    except RuntimeError as error:
        if "not found" not in str(error):
            return  # the integrator exists, and requires parameters
        builtin = ", ".join(_plugins_of_mitsuba(mi.ObjectType.Integrator))
        raise UsageError(
            f"unknown integrator '{name}'; there are {', '.join(own_integrators())} and Mitsuba's {builtin}"
        ) from None


def check_output(file):
    """Raise UsageError if the folder of an output file does not exist or is not writable."""
    folder = file.absolute().parent
    if not folder.is_dir():
        raise UsageError(f"no folder '{folder}' for the output")
    make_folder(folder)


def check_sampler(name):
    """Raise UsageError with the list of samplers if none has the given name."""
    known = _plugins_of_mitsuba(mi.ObjectType.Sampler)
    if name not in known:
        raise UsageError(f"unknown sampler '{name}'; there are {', '.join(known)}")


def _plugins_of_mitsuba(kind):
    """Return the sorted names of Mitsuba's plugins of an object type."""
    manager, folder = mi.PluginManager.instance(), Path(mi.__file__).parent / "plugins"
    return sorted(name for name in {file.stem for file in folder.iterdir()} if manager.plugin_type(name) == kind)


def check_parameters(title, name, parameters):
    """Raise UsageError for parameters that an integrator refuses or does not have; `title` names it in the message.
    Integrators that need parts from a scene, and so cannot be created alone, are not checked."""
    properties = mi.Properties(name)
    for key, content in parameters.items():
        properties[key] = content
    try:
        mi.PluginManager.instance().create_object(properties)
    except (RuntimeError, ValueError) as error:
        if _can_be_created(name):
            raise UsageError(f"{title}: {explain(error)}") from None
        return
    unknown = [key for key in parameters if not properties.was_queried(key)]
    if unknown:
        raise UsageError(f"{title}: the integrator '{name}' has no parameter '{unknown[0]}'")


def _can_be_created(name):
    try:
        mi.PluginManager.instance().create_object(mi.Properties(name))
    except (RuntimeError, ValueError):
        return False
    return True


def make_folder(path):
    """Make a folder and its parents; raises UsageError if it is not writable."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise UsageError(f"cannot write to the folder '{path}': {error.strerror}") from None


def integrators_with_aovs():
    """Return the names of this project's integrators with AOVs."""
    return tuple(name for name in own_integrators() if not aov_refusal(name, ""))


def aov_refusal(integrator, aov):
    """Return the message, with the allowed AOVs, by which an integrator of this project refuses an AOV; otherwise
    None."""
    properties = mi.Properties(integrator)
    properties["aovs"] = aov
    try:
        mi.PluginManager.instance().create_object(properties)
    except (RuntimeError, ValueError) as error:
        return explain(error)
    return None


def check_scene(path):
    """Raise UsageError if the scene file does not exist."""
    if not Path(path).is_file():
        raise UsageError(f"no scene file '{path}'")


def explain(error):
    """Return the message of the first cause of an error in one line, without locations in Mitsuba's sources. (Dr.Jit
    wraps the exceptions of integrators.)"""
    while error.__cause__ is not None:
        error = error.__cause__
    message = re.sub(r"\[\w+\.cpp:\d+\] ", "", str(error))
    return " ".join(message.split()) or type(error).__name__


def failure(error):
    """Return the entries of results for the current exception: its one-line message, and its traceback."""
    return {"error": explain(error), "traceback": traceback.format_exc()}


def exit_status(program, run, interrupted, verbose):
    """Run a command and return its exit status; an exception becomes one line on the standard error.

    `run`: returns the status; `interrupted`: returns a message about the state after Ctrl-C; `verbose`: raise
    exceptions.
    """
    try:
        with interruptions_kept():
            return run()
    except KeyboardInterrupt:
        print(f"\n{program}: interrupted; {interrupted()}", file=sys.stderr)
        return 130
    except Exception as error:
        if verbose:
            raise
        print(f"{program}: {explain(error)}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1


def versions():
    """Return the versions (text) of the software that an image depends on."""
    return {name: metadata.version(name) for name in ("mitsuba", "drjit", "numpy")} | {"manylights": own_version()}


def own_version():
    try:
        return metadata.version("manylights")
    except metadata.PackageNotFoundError:  # run from a source tree without installation
        return "unknown"
