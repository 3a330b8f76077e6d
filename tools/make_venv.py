"""Make a virtual environment with ROS 2 Jazzy and this project in it, or bring an existing one up to date.

    python3 tools/make_venv.py [.venv] [--extras all,dev] [--pin 'numpy==1.26.*' ...]

Where a ROS is sourced, the environment uses that one and installs no ROS wheel over it. The standard library only, and
no syntax newer than Python 3.6, so that a Python that is too old gets one clear line instead of a traceback.
"""

import argparse
import hashlib
import os
import platform
import shutil
import subprocess
import sys

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
DISTRO = "jazzy"
OLDEST = (3, 11)
NEWEST_WHEEL = (3, 13)
REQUIREMENT_FILES = ("package.xml", "setup.py", "setup.cfg", "pyproject.toml", "tools/make_venv.py")
# What the ROS wheels' start-up hook leaves behind: with these set, another environment would load our libraries.
WHEEL_VARIABLES = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH")


class Refusal(Exception):
    """Something is missing here; the message is the one line the user sees."""


def dotted(version):
    """Return (3, 11) as '3.11'."""
    return ".".join(str(part) for part in version)


def sourced_prefixes():
    """Return the prefixes of a sourced ROS: those of AMENT_PREFIX_PATH outside this project's environments."""
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    own = os.path.join(os.path.realpath(ROOT), ".venv")
    return [p for p in prefixes if not os.path.realpath(p).startswith(own)]


def check_machine(sourced):
    """Refuse a machine on which the installation could not succeed, and say what to do."""
    if sourced and os.environ.get("ROS_DISTRO", DISTRO) != DISTRO:
        raise Refusal(
            "ROS 2 %s is sourced, but track_fusion needs %s: open a shell without it, or source %s."
            % (os.environ["ROS_DISTRO"], DISTRO, DISTRO)
        )
    check_python(sourced)
    machine = (platform.system(), platform.machine())
    if not sourced and machine != ("Linux", "x86_64"):
        raise Refusal(
            "There are no ROS 2 wheels for %s %s: install ros-%s-ros-base with apt (Ubuntu 24.04) and source its "
            "setup.bash first." % (machine + (DISTRO,))
        )
    try:
        import ensurepip  # noqa: F401  Debian and Ubuntu ship it in a package of its own
        import venv  # noqa: F401
    except ImportError:
        raise Refusal(
            "This Python cannot make environments: install its venv module (Debian and Ubuntu: "
            "sudo apt install python%s-venv)." % dotted(sys.version_info[:2])
        ) from None


def check_python(sourced):
    """Refuse a Python that is too old, or too new for the ROS wheels; name one at hand that would do."""
    version = sys.version_info[:2]
    too_new = not sourced and version > NEWEST_WHEEL
    if OLDEST <= version and not too_new:
        return
    allowed = dotted(OLDEST) + (" or newer" if sourced else " to " + dotted(NEWEST_WHEEL))
    names = ["python3.%d" % minor for minor in range(NEWEST_WHEEL[1], OLDEST[1] - 1, -1)]
    usable = [name for name in names if works(name)]
    advice = "run make again with PYTHON=%s." % usable[0] if usable else "install one (with venv) and set PYTHON=."
    raise Refusal("Python %s is needed; this is %s: %s" % (allowed, platform.python_version(), advice))


def works(name):
    """Return whether an interpreter of that name is there and runs (a version manager's stub may not)."""
    path = shutil.which(name)
    return bool(path) and subprocess.call([path, "-c", ""], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) == 0


def clean_environment():
    """Return this process's environment without what an active ROS wheel environment set in it."""
    env = dict(os.environ)
    if env.get(WHEEL_VARIABLES[0]):
        for name in WHEEL_VARIABLES:
            env.pop(name, None)
    for name in ("VIRTUAL_ENV", "PYTHONHOME"):
        env.pop(name, None)
    return env


def settings(folder):
    """Return the pyvenv.cfg of an environment as a dict, empty when there is none."""
    path = os.path.join(folder, "pyvenv.cfg")
    if not os.path.exists(path):
        return {}
    with open(path) as file:
        pairs = [line.split("=", 1) for line in file if "=" in line]
    return {key.strip(): value.strip() for key, value in pairs}


def fits(folder, sourced):
    """Return whether an environment is there, of this Python's version and of the right kind."""
    found = settings(folder)
    right_version = found.get("version") == platform.python_version()
    right_kind = found.get("include-system-site-packages") == ("true" if sourced else "false")
    return right_version and right_kind and os.path.exists(os.path.join(folder, "bin", "pip"))


def create(folder, sourced):
    """Make an empty environment, clearing what was there."""
    python = getattr(sys, "_base_executable", sys.executable)  # not that of an active environment
    command = [python, "-m", "venv", "--clear"] + (["--system-site-packages"] if sourced else []) + [folder]
    if subprocess.call(command, env=clean_environment()) != 0:
        raise Refusal("Could not make the environment %s (the lines above say why)." % folder)
    check = [os.path.join(folder, "bin", "python"), "-c", "import rclpy"]
    if sourced and subprocess.call(check, stderr=subprocess.DEVNULL) != 0:
        shutil.rmtree(folder)
        raise Refusal(
            "ROS 2 is sourced (%s), but %s cannot import its rclpy: set PYTHON to the Python that ROS was built "
            "for, such as PYTHON=/usr/bin/python3." % (sourced[0], python)
        )


def install(folder, extras, pins, sourced):
    """Install the project (editable) with its extras, and the ROS wheels where no ROS is sourced."""
    extras = extras + ([] if sourced else ["ros"])
    project = ROOT + ("[%s]" % ",".join(extras) if extras else "")
    pip = [os.path.join(folder, "bin", "python"), "-m", "pip", "install", "-qq", "--disable-pip-version-check"]
    if subprocess.call(pip + ["-e", project] + pins, env=clean_environment()) != 0:
        raise Refusal("pip could not install the project into %s (the lines above say why)." % folder)


def state_of(extras, pins):
    """Return a digest of all that decides what is installed."""
    digest = hashlib.sha256(repr((ROOT, extras, pins)).encode())
    for name in REQUIREMENT_FILES:
        with open(os.path.join(ROOT, name), "rb") as file:
            digest.update(file.read())
    return digest.hexdigest()


def make(folder, extras, pins):
    """Create or update one environment; return at once when it is up to date."""
    sourced = sourced_prefixes()
    check_machine(sourced)
    stamp, wanted, name = os.path.join(folder, ".stamp"), state_of(extras, pins), os.path.basename(folder)
    reuse = fits(folder, sourced)
    if reuse and os.path.exists(stamp):
        with open(stamp) as file:
            if file.read() == wanted:
                return
    source = "the sourced ROS 2 in " + sourced[0] if sourced else "ROS 2 wheels (a download of 250 MB when not cached)"
    print("%s %s with %s; a minute or two ..." % ("Updating" if reuse else "Making", name, source), flush=True)
    if not reuse:
        create(folder, sourced)
    elif os.path.exists(stamp):
        os.remove(stamp)
    install(folder, extras, pins, sourced)
    with open(stamp, "w") as file:
        file.write(wanted)
    print("%s is ready." % name, flush=True)


def main():
    """Read the command line; print a refusal as one line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", default=".venv")
    parser.add_argument("--extras", default="all,dev", help="extras of setup.py, separated by commas")
    parser.add_argument("--pin", action="append", default=[], help="a further requirement, such as numpy==1.26.*")
    options = parser.parse_args()
    extras = [extra for extra in options.extras.split(",") if extra]
    try:
        make(os.path.join(ROOT, options.folder), extras, options.pin)
    except Refusal as refusal:
        sys.exit("track_fusion: %s" % refusal)


if __name__ == "__main__":
    main()
