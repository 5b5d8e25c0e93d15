#!/usr/bin/env bash
# Makes everything ready on a fresh Debian or Ubuntu machine: .venv with tested versions, and the system
# libraries that OpenGL needs. Safe to run again: what is there already is left alone.
#
#   bash setup.sh          to use pansplat
#   bash setup.sh --dev    to work on it as well (tests, linters, a virtual display)
#   bash setup.sh --cuda   with PyTorch's CUDA build even where no NVIDIA GPU is seen (--cpu: never)
#
# PYTHON=python3.12 bash setup.sh takes that Python (3.10 or newer) for .venv.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"

CPU_WHEELS=https://download.pytorch.org/whl/cpu
GL_PACKAGES=(libegl1 libgl1 libgl1-mesa-dri libgles2 libx11-6 libxcursor1 libxext6 libxi6 libxinerama1 libxkbcommon0 libxrandr2)
DEV_PACKAGES=(xvfb xdotool libosmesa6)

say() { printf 'setup: %s\n' "$*"; }
die() { printf 'setup: %s\n' "$*" >&2; exit 1; }

extra="" build=auto
for argument in "$@"; do
    case $argument in
        --dev) extra="[dev]" ;;
        --cuda) build=cuda ;;
        --cpu) build=cpu ;;
        -h | --help) sed -n '2,9s/^# \{0,1\}//p' "$0"; exit 0 ;;
        *) die "unknown option $argument (known: --dev --cpu --cuda --help)" ;;
    esac
done

# How to become root without being asked for a password; empty when there is no way.
if [ "$(id -u)" = 0 ]; then as_root=(env)
elif sudo -n true 2>/dev/null; then as_root=(sudo -n)
else as_root=()
fi

apt_updated=""
apt_install() {
    command -v apt-get >/dev/null && [ ${#as_root[@]} -gt 0 ] || return 1
    if [ -z "$apt_updated" ]; then
        "${as_root[@]}" apt-get update -qq || say "apt-get update failed; trying with the lists there are"
        apt_updated=yes
    fi
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}

installed() { dpkg-query -W -f '${Status}' "$1" 2>/dev/null | grep -q 'ok installed'; }

# --- system libraries ---
install_libraries() {
    command -v dpkg-query >/dev/null || { say "no Debian or Ubuntu here: OpenGL, EGL and X11 libraries are yours to install"; return; }
    local wanted=("${GL_PACKAGES[@]}") missing=() package
    [ -z "$extra" ] || wanted+=("${DEV_PACKAGES[@]}")
    for package in "${wanted[@]}"; do installed "$package" || missing+=("$package"); done
    [ ${#missing[@]} -gt 0 ] || return 0
    if [ ${#as_root[@]} = 0 ]; then
        say "the viewer needs system libraries that are missing; please run"
        say "    sudo apt-get install ${missing[*]}"
        return
    fi
    say "installing ${missing[*]}"
    # One by one when all together fail: a release may lack one of them (libosmesa6 left newer ones).
    apt_install "${missing[@]}" && return
    for package in "${missing[@]}"; do apt_install "$package" || say "could not install $package; going on without it"; done
}

# --- Python ---
find_python() {
    python=${PYTHON:-python3}
    command -v "$python" >/dev/null || apt_install python3 python3-venv \
        || die "needs Python 3.10 or newer; run: sudo apt-get install python3 python3-venv"
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' \
        || die "needs Python 3.10 or newer, $python is $("$python" -V 2>&1); give another with PYTHON=python3.12 bash setup.sh"
}

make_venv() {
    if .venv/bin/python -c 'import pip, sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then return; fi
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        local package
        package=$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
        say "installing $package"
        apt_install "$package" || apt_install python3-venv \
            || die "Python's venv module is missing; run: sudo apt-get install $package"
    fi
    say "making .venv with $("$python" -V)"
    "$python" -m venv --clear .venv
}

# --- packages ---
pip_install() { .venv/bin/python -m pip install --disable-pip-version-check -qq -c constraints.txt "$@"; }

# A plain `pip install torch` pulls gigabytes of CUDA on Linux, so a machine without a GPU asks for the CPU build by
# name: first where pip looks anyway (a mirror or a folder of wheels may have it), then from PyTorch.
install_torch() {
    local version
    version=$(sed -n 's/^torch==\([0-9.]*\).*/\1/p' constraints.txt)
    if [ "$build" = auto ]; then
        if nvidia-smi -L >/dev/null 2>&1; then build=cuda; else build=cpu; fi
    fi
    if [ "$build" = cuda ] || [ "$(uname -s)" != Linux ]; then
        pip_install "torch==$version"
        return
    fi
    if .venv/bin/python -c "import importlib.metadata as m, sys; sys.exit(m.version('torch') != '$version+cpu')" 2>/dev/null; then
        return
    fi
    say "installing PyTorch $version for the CPU"
    local log
    log=$(mktemp)
    if ! pip_install --retries 1 "torch==$version+cpu" 2>"$log" \
        && ! pip_install --retries 1 --extra-index-url "$CPU_WHEELS" "torch==$version+cpu" 2>>"$log"; then
        cat "$log" >&2
        rm -f "$log"
        die "found no CPU build of PyTorch $version, neither where pip looks nor at $CPU_WHEELS. Is the network up?
       (bash setup.sh --cuda takes the large default build instead)"
    fi
    rm -f "$log"
}

install_packages() {
    local stamp=.venv/pansplat-setup mark
    mark="$(cat constraints.txt pyproject.toml setup.sh | sha256sum) $build"
    # With [dev] installed the plain set is there, too.
    if [ "$(cat "$stamp" 2>/dev/null)" = "$mark [dev]" ] || [ "$(cat "$stamp" 2>/dev/null)" = "$mark $extra" ]; then
        return
    fi
    install_torch
    say "installing pansplat$extra"
    pip_install -e ".$extra"
    echo "$mark $extra" >"$stamp"
}

# --- kernels ---
# Numba keeps the compiled kernels; later runs load them in a second.
compile_kernels() {
    say "compiling the CPU kernels (about a minute, once)"
    .venv/bin/python -m pansplat.warm_up || say "the kernels could not be compiled; the first command compiles them"
}

find_python
make_venv
install_libraries
install_packages
compile_kernels
say "ready: .venv/bin/pansplat --help, .venv/bin/pansplat-view assets/living_room"
