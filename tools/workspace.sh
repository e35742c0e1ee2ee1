# shellcheck shell=bash
# Sourced by the tools in bash: Debian's packages, a catkin workspace around this clone, an environment of their
# own. What they write goes to build/ in the clone, and nothing of the caller's ROS or Python is used.

root=$(cd -P "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
logs=$root/build/logs
# Hidden, since roslaunch searches all other folders of a package: in a clone that is itself part of a workspace it
# would find each launch file twice. Elsewhere if the clone's path has a space in it, where catkin and rosrun split it.
ws=$root/build/.ws
if [[ $root == *[!A-Za-z0-9_./+-]* ]]; then
  ws=${XDG_CACHE_HOME:-$HOME/.cache}/pharos/$(cksum <<<"$root" | cut -d ' ' -f 1)
fi

# Debian's own tools and python3 only: another python3 earlier on PATH, a virtual environment or an overlay has no
# rospy, or another one. The address is the loopback's, whatever the host's name resolves to.
unset "${!ROS@}" PYTHONPATH PYTHONHOME CMAKE_PREFIX_PATH
export PATH=/usr/sbin:/usr/bin:/sbin:/bin PYTHONNOUSERSITE=1 PYTHONUNBUFFERED=1
# Debian's catkin asks for CMake 3.0.2 in the file that it puts at the top of a workspace, which CMake 4 refuses.
export CMAKE_POLICY_VERSION_MINIMUM=3.5
export ROS_HOSTNAME=127.0.0.1 ROS_HOME=$ws/ros_home ROS_LOG_DIR=$ws/ros_home/log

say() { printf '== %s\n' "$*"; }

fail() {
  printf 'tools/%s: %s\n' "${0##*/}" "$*" >&2
  exit 1
}

# quietly LOG COMMAND...: the command's output goes to the log, and is shown where it fails.
quietly() {
  local log=$logs/$1
  shift
  mkdir -p "$logs"
  "$@" >"$log" 2>&1 </dev/null && return
  tail -n 60 "$log" >&2
  printf "tools/%s: '%s' failed; its whole output is in %s\n" "${0##*/}" "$*" "$log" >&2
  return 1
}

# free_port: prints a port of the loopback's that nobody has.
free_port() {
  python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])'
}

# install_packages NAME...: those that are missing; nothing is asked of the network where none is.
install_packages() {
  local installed package missing=()
  command -v apt-get >/dev/null || fail "no apt-get here: this command is for Debian 12 and 13"
  installed=" $(dpkg-query -W -f '${Package}:${db:Status-Status} ' "$@" 2>/dev/null)" || true
  for package; do
    [[ $installed == *" $package:installed "* ]] || missing+=("$package")
  done
  ((${#missing[@]})) || return 0
  if ((EUID)) && ! command -v sudo >/dev/null; then
    fail "neither root nor sudo: as root, run: apt-get install --no-install-recommends ${missing[*]}"
  fi
  say "installing from Debian, this once: ${missing[*]}"
  # An update that misses one source of several may still serve: apt-get install decides.
  quietly apt-update.log as_root apt-get update || true
  quietly apt-install.log as_root env DEBIAN_FRONTEND=noninteractive \
    apt-get -o DPkg::Lock::Timeout=300 install -y --no-install-recommends "${missing[@]}" || exit 1
}

as_root() {
  if ((EUID)); then sudo "$@"; else "$@"; fi
}

# build_workspace devel|install: builds the devel space, and the install space where asked, if not up to date.
# The devel space uses the clone's Python files where they are: there only what CMake reads counts.
build_workspace() {
  local lock devel install
  mkdir -p "$root/build" "$ws"
  exec {lock}>"$ws/lock"
  flock "$lock" # two commands may be started at once
  devel=$(cd "$root" && { pwd && ls . scripts && cat CMakeLists.txt package.xml setup.py; } | cksum)
  if [[ $devel != "$(cat "$ws/devel.key" 2>/dev/null)" ]]; then
    say "building the catkin workspace"
    rm -rf "$ws"/{src,build,devel,devel.key,install,install.key}
    mkdir -p "$ws/src/pharos"
    # Each entry by itself, not the clone as a whole: it holds build/, which would be a loop to rosrun's find -L.
    find "$root" -mindepth 1 -maxdepth 1 ! -name '.*' ! -name build -exec ln -s -t "$ws/src/pharos" {} +
    quietly catkin-devel.log catkin_make -C "$ws" --no-color -DPYTHON_EXECUTABLE=/usr/bin/python3 || exit 1
    printf '%s\n' "$devel" >"$ws/devel.key"
  fi
  if [[ $1 == install ]]; then
    install=$(cd "$root" && find src scripts launch examples template -type f ! -name '*.pyc' -exec cksum {} + | sort | cksum)
    if [[ $install != "$(cat "$ws/install.key" 2>/dev/null)" ]]; then
      say "installing the package into the workspace"
      rm -rf "$ws"/{install,install.key}
      quietly catkin-install.log catkin_make -C "$ws" --no-color install || exit 1
      printf '%s\n' "$install" >"$ws/install.key"
    fi
  fi
  exec {lock}>&-
}

# use_space devel|install: what a user's shell has after sourcing that setup.bash.
use_space() {
  set +u # catkin's setup files read variables that may not be set
  # shellcheck disable=SC1090
  source "$ws/$1/setup.bash"
  set -u
}
