#!/usr/bin/env bash
# Set up pansplat on a Debian or Ubuntu machine: .venv with tested versions, the system libraries of OpenGL,
# and compiled CPU kernels. You may run it again at any time: it skips the steps that are done.
#
#   bash setup.sh          to use pansplat
#   bash setup.sh --dev    to develop it (tests, linters, a virtual display, an emulated headset)
#   bash setup.sh --cuda   to install PyTorch's CUDA build even without a visible NVIDIA GPU (--cpu: never)
#
# PYTHON=python3.12 bash setup.sh makes .venv with that Python (3.10 or newer).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"

CPU_WHEELS=https://download.pytorch.org/whl/cpu
GL_PACKAGES=(libegl1 libgl1 libgl1-mesa-dri libgles2 libx11-6 libxcursor1 libxext6 libxi6 libxinerama1 libxkbcommon0 libxrandr2)
DEV_PACKAGES=(xvfb xdotool libosmesa6 chromium libatomic1) # libatomic1: for the node of playwright
IWER=iwer@2.5.0 # npm package: the emulated headset of the tests
IWER_SHA256=23d8640949f19db4b1e70398b30e084e4aa555f3a81e4329da3fac1a70b39542 # of iwer.min.js

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

# The prefix that runs a command as root without a password; empty if there is none.
if [ "$(id -u)" = 0 ]; then as_root=(env)
elif sudo -n true 2>/dev/null; then as_root=(sudo -n)
else as_root=()
fi

apt_updated=""
apt_install() {
    command -v apt-get >/dev/null && [ ${#as_root[@]} -gt 0 ] || return 1
    if [ -z "$apt_updated" ]; then
        "${as_root[@]}" apt-get update -qq || say "apt-get update failed; using the existing package lists"
        apt_updated=yes
    fi
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}

installed() { dpkg-query -W -f '${Status}' "$1" 2>/dev/null | grep -q 'ok installed'; }

# --- system libraries ---
install_libraries() {
    command -v dpkg-query >/dev/null || { say "this is not Debian or Ubuntu; please install the OpenGL, EGL and X11 libraries with your package manager"; return; }
    local required=("${GL_PACKAGES[@]}") missing=() package
    [ -z "$extra" ] || required+=("${DEV_PACKAGES[@]}")
    for package in "${required[@]}"; do installed "$package" || missing+=("$package"); done
    [ ${#missing[@]} -gt 0 ] || return 0
    local failed=("${missing[@]}")
    if [ ${#as_root[@]} -gt 0 ]; then
        say "installing ${missing[*]}"
        # If this fails, install the packages one by one: some releases lack one of them (newer ones lack libosmesa6).
        apt_install "${missing[@]}" && return
        failed=()
        for package in "${missing[@]}"; do apt_install "$package" || failed+=("$package"); done
        [ ${#failed[@]} -gt 0 ] || return 0
    fi
    say "system packages are missing; everything but the window and OpenGL works without them. To install them, run"
    say "    sudo apt-get install ${failed[*]}"
}

# --- Python ---
find_python() {
    python=${PYTHON:-python3}
    command -v "$python" >/dev/null || apt_install python3 python3-venv \
        || die "Python 3.10 or newer is missing; run: sudo apt-get install python3 python3-venv"
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' \
        || die "Python must be 3.10 or newer, got $("$python" -V 2>&1) ($python); choose another with PYTHON=python3.12 bash setup.sh"
}

make_venv() {
    if .venv/bin/python -c 'import pip, sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then return; fi
    say "creating .venv with $("$python" -V)"
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        local package
        package=$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
        # Without the package, Debian's Python has venv, but not the pip that it copies into it.
        if ! apt_install "$package" && ! apt_install python3-venv; then
            "$python" -m venv --without-pip --clear .venv && "$python" -m pip --python .venv/bin/python install -q pip \
                || die "Python's venv module is missing; run: sudo apt-get install $package"
            return
        fi
    fi
    "$python" -m venv --clear .venv
}

# --- packages ---
# Python compiles a module at its first import; pip would compile thousands that are never imported. The first imports are
# those of this script, so their bytecode is written even where the environment forbids it: without it each start of a
# command takes seconds more.
unset PYTHONDONTWRITEBYTECODE
pip_install() { .venv/bin/python -m pip install --disable-pip-version-check -qq --no-compile -c constraints.txt "$@"; }

# On Linux a plain `pip install torch` downloads gigabytes of CUDA libraries. So without a GPU the CPU build is installed
# by its version, first from pip's configured sources (a mirror or a folder of wheels may have it), then from PyTorch.
install_torch() {
    local version
    version=$(sed -n 's/^torch==\([0-9.]*\).*/\1/p' constraints.txt)
    if [ "$build" = auto ]; then
        if nvidia-smi -L >/dev/null 2>&1; then build=cuda; else build=cpu; fi
    fi
    local has_cpu_build=""
    if .venv/bin/python -c "import importlib.metadata as m, sys; sys.exit(m.version('torch') != '$version+cpu')" 2>/dev/null; then
        has_cpu_build=yes
    fi
    if [ "$build" = cuda ] || [ "$(uname -s)" != Linux ]; then
        pip_install ${has_cpu_build:+--force-reinstall} "torch==$version"  # pip takes the CPU build for this version, too
        return
    fi
    [ -z "$has_cpu_build" ] || return 0
    say "installing PyTorch $version for the CPU"
    local log
    log=$(mktemp)
    if ! pip_install --retries 1 "torch==$version+cpu" 2>"$log" \
        && ! pip_install --retries 1 --extra-index-url "$CPU_WHEELS" "torch==$version+cpu" 2>>"$log"; then
        cat "$log" >&2
        rm -f "$log"
        die "found no CPU build of PyTorch $version in pip's sources or at $CPU_WHEELS; check the network connection
       (bash setup.sh --cuda installs the large default build instead)"
    fi
    rm -f "$log"
}

install_packages() {
    local stamp=.venv/pansplat-setup mark
    mark="$(cat constraints.txt pyproject.toml setup.sh | cksum) $build"
    # The packages of [dev] include the plain ones.
    if [ "$(cat "$stamp" 2>/dev/null)" = "$mark [dev]" ] || [ "$(cat "$stamp" 2>/dev/null)" = "$mark $extra" ]; then
        return
    fi
    install_torch
    say "installing pansplat$extra"
    pip_install -e ".$extra"
    echo "$mark $extra" >"$stamp"
}

# --- emulated headset ---
install_headset() {
    local file=.venv/iwer/iwer.min.js folder
    [ -n "$extra" ] || return 0
    ! echo "$IWER_SHA256  $file" | sha256sum --check --status 2>/dev/null || return 0
    command -v npm >/dev/null || apt_install npm || { say "npm is missing; continuing without $IWER, which tests of web pages need"; return; }
    say "fetching $IWER"
    folder=$(mktemp -d)
    if npm pack --silent --pack-destination "$folder" "$IWER" >/dev/null && tar -xzf "$folder"/*.tgz -C "$folder" \
        && echo "$IWER_SHA256  $folder/package/build/iwer.min.js" | sha256sum --check --status; then
        mkdir -p "${file%/*}"
        mv "$folder/package/build/iwer.min.js" "$file"
    else
        say "could not fetch $IWER, or its checksum differs; continuing without it"
    fi
    rm -rf "$folder"
}

# --- kernels ---
# Numba caches the compiled kernels, so only the first run takes long.
compile_kernels() {
    say "compiling the CPU kernels (about a minute the first time)"
    .venv/bin/python -m pansplat.cli.warm_up || say "could not compile the CPU kernels; the first command that uses them compiles them"
}

find_python
make_venv
install_libraries
install_packages
install_headset
compile_kernels
say "ready: .venv/bin/pansplat --help, .venv/bin/pansplat-view assets/living_room"
