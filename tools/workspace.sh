# Sourced by the tools in bash: Debian's packages, and a catkin workspace around this clone, in build/.

root=$(cd -P "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
logs=$root/build/logs
# Hidden, since roslaunch searches all other folders of a package. catkin and rosrun split a path at a space.
ws=$root/build/.ws
if [[ $root == *[!A-Za-z0-9_./+-]* ]]; then
  ws=${XDG_CACHE_HOME:-$HOME/.cache}/pharos/$(cksum <<<"$root" | cut -d ' ' -f 1)
fi

# Debian's own tools and python3 only: another python3 has no rospy, or another one.
unset "${!ROS@}" PYTHONPATH PYTHONHOME CMAKE_PREFIX_PATH
export PATH=/usr/sbin:/usr/bin:/sbin:/bin PYTHONNOUSERSITE=1 PYTHONUNBUFFERED=1
export CMAKE_POLICY_VERSION_MINIMUM=3.5 # Debian's catkin asks for CMake 3.0.2, which CMake 4 refuses
export ROS_HOSTNAME=127.0.0.1 ROS_HOME=$ws/ros_home ROS_LOG_DIR=$ws/ros_home/log

# usage: prints the comment that a tool begins with.
usage() { sed -n '2,/^[^#]/s/^# \?//p' "$0"; }

say() { printf '== %s\n' "$*"; }
fail() { printf 'tools/%s: %s\n' "${0##*/}" "$*" >&2 && exit 1; }
as_root() { if ((EUID)); then sudo "$@"; else "$@"; fi; }

# quietly LOG COMMAND...: the command's output goes to the log, and is shown if it fails.
quietly() {
  local log=$logs/$1
  shift && mkdir -p "$logs"
  "$@" >"$log" 2>&1 </dev/null && return
  tail -n 60 "$log" >&2
  printf "tools/%s: '%s' failed; its whole output is in %s\n" "${0##*/}" "$*" "$log" >&2
  return 1
}

# install_packages NAME...: those that are missing.
install_packages() {
  local installed package missing=()
  command -v apt-get >/dev/null || fail "no apt-get here: this command is for Debian 11 to 14"
  installed=" $(dpkg-query -W -f '${Package}:${db:Status-Status} ' "$@" 2>/dev/null)" || true
  for package; do
    [[ $installed == *" $package:installed "* ]] || missing+=("$package")
  done
  ((${#missing[@]})) || return 0
  ((EUID == 0)) || command -v sudo >/dev/null || fail "neither root nor sudo: as root, run: apt-get install ${missing[*]}"
  say "installing from Debian, this once: ${missing[*]}"
  quietly apt-update.log as_root apt-get update || true # some sources may do: apt-get install decides
  quietly apt-install.log as_root env DEBIAN_FRONTEND=noninteractive \
    apt-get -o DPkg::Lock::Timeout=300 install -y --no-install-recommends "${missing[@]}" || exit 1
}

# build_workspace devel|install: builds the devel space, and the install space if asked, unless they are up to date.
build_workspace() {
  local space key files
  mkdir -p "$root/build" "$ws"
  for space in devel ${1/devel/}; do
    files='CMakeLists.txt package.xml setup.py' # the devel space uses the clone's Python files where they are
    [[ $space == devel ]] || files+=' src scripts launch examples template'
    key=$(cd "$root" && { pwd && ls . scripts && find $files -type f ! -name '*.pyc' -exec cksum {} + | sort; } | cksum)
    [[ $key != "$(cat "$ws/$space.key" 2>/dev/null)" ]] || continue
    say "building the $space space of the catkin workspace"
    rm -rf "$ws/$space" "$ws/install.key"
    if [[ $space == devel ]]; then
      rm -rf "$ws/src" "$ws/build"
      mkdir -p "$ws/src/pharos"
      # Each entry by itself: the clone holds build/, which would be a loop to rosrun's find -L.
      find "$root" -mindepth 1 -maxdepth 1 ! -name '.*' ! -name build -exec ln -s -t "$ws/src/pharos" {} +
    fi
    quietly "catkin-$space.log" catkin_make -C "$ws" --no-color -DPYTHON_EXECUTABLE=/usr/bin/python3 ${space/devel/all} || exit 1
    printf '%s\n' "$key" >"$ws/$space.key"
  done
}

# use_space devel|install: sources setup.bash, which reads variables that may not be set.
use_space() { set +u && source "$ws/$1/setup.bash" && set -u; }
