#!/bin/sh
# Create .venv with the pinned packages and this project in editable form. Does nothing when it is up to date.
# Finds what uv finds if uv is present, else python3.12 / python3.13 on the path, else pyenv's versions directory;
# only when none is installed, uv may download an interpreter.
set -eu
cd "$(dirname "$0")/.."

VENV=.venv
PYTHON="$VENV/bin/python"
STAMP="$VENV/.vtrefine-installed"

say() { printf '%s\n' "$*" >&2; }

# True when the given interpreter starts, is a supported version and can make virtual environments. A pyenv shim
# of a version that is not selected exists on the path but does not start.
usable() {
    "$1" -c 'import sys, venv, ensurepip; sys.exit(not (3, 12) <= sys.version_info[:2] < (3, 14))' >/dev/null 2>&1
}

# True when the existing environment has a supported version and something can install into it; one made by uv needs
# neither pip nor ensurepip.
reusable() {
    "$PYTHON" -c 'import sys; sys.exit(not (3, 12) <= sys.version_info[:2] < (3, 14))' >/dev/null 2>&1 || return 1
    command -v uv >/dev/null 2>&1 || [ -x "$VENV/bin/uv" ] || usable "$PYTHON"
}

find_python() {
    for candidate in python3.12 python3.13 python3 python \
        "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.12*/bin/python \
        "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.13*/bin/python; do
        if usable "$candidate"; then
            printf '%s\n' "$candidate"
            return 0
        fi
    done
    return 1
}

uv_venv() {
    rm -rf "$VENV"
    command -v uv >/dev/null 2>&1 && uv venv --quiet --python '>=3.12,<3.14' "$@" "$VENV" 2>/dev/null
}

# A download of an interpreter may hang where only the package registry can be reached: it comes last.
create_venv() {
    if uv_venv --no-python-downloads; then
        return 0
    fi
    rm -rf "$VENV"
    if base=$(find_python); then
        say "Creating $VENV with $base"
        "$base" -m venv "$VENV"
    elif ! uv_venv; then
        say "error: no Python 3.12 or 3.13 with the venv module found; install one, e.g. 'apt-get install python3.12-venv', 'pyenv install 3.12' or uv"
        exit 2
    fi
}

# uv from the path, else the pinned one from inside the environment: several times faster than pip.
find_uv() {
    if command -v uv >/dev/null 2>&1; then
        printf 'uv\n'
    elif [ -x "$VENV/bin/uv" ] || "$PYTHON" -m pip install --quiet --disable-pip-version-check -c constraints.txt uv; then
        printf '%s\n' "$VENV/bin/uv"
    fi
}

install() {
    quiet=--quiet
    if [ -t 2 ]; then quiet=; fi
    say "Installing the pinned packages (the first time downloads about 3 GB, most of it PyTorch) ..."
    uv=$(find_uv)
    # Without bytecode, commands compile LeRobot and PyTorch anew, each time where Python is told not to write it.
    # shellcheck disable=SC2086
    if [ -n "$uv" ] && "$uv" pip install $quiet --compile-bytecode --python "$PYTHON" -c constraints.txt -e '.[dev]'; then
        return 0
    fi
    say "uv could not install them; trying pip ..."
    "$PYTHON" -m pip --version >/dev/null 2>&1 || "$PYTHON" -m ensurepip >/dev/null
    "$PYTHON" -m pip install --quiet --disable-pip-version-check --progress-bar on -c constraints.txt -e '.[dev]'
}

wanted="$(cat pyproject.toml constraints.txt scripts/setup_venv.sh | cksum) $(pwd -P)"
if [ -x "$PYTHON" ] && [ "$(cat "$STAMP" 2>/dev/null)" = "$wanted" ]; then
    exit 0
fi
reusable || create_venv
started=$(date +%s)
install
printf '%s\n' "$wanted" >"$STAMP"
say "Set-up finished in $(($(date +%s) - started)) s"
