#!/bin/sh
# Installs the tools that build the simulators outside Python, or reports what is missing.
set -eu

missing=""
command -v g++ > /dev/null || missing="$missing g++"
command -v pkg-config > /dev/null || missing="$missing pkg-config"
command -v javac > /dev/null || missing="$missing openjdk-17-jdk-headless"
pkg-config --exists ns3-core gsl 2> /dev/null || missing="$missing libns3-dev libgsl-dev"
echo "#include <enki/PhysicalEngine.h>" | g++ -E -x c++ - > /dev/null 2>&1 || missing="$missing libenki-dev"
/usr/bin/python3 -c "import geometry_msgs, rosgraph_msgs, rosmaster, rospy" 2> /dev/null ||
    missing="$missing python3-rospy python3-rosmaster python3-geometry-msgs python3-rosgraph-msgs"

[ -n "$missing" ] || exit 0
if [ "$(id -u)" = 0 ] && command -v apt-get > /dev/null; then
    apt-get update -qq
    # shellcheck disable=SC2086
    DEBIAN_FRONTEND=noninteractive apt-get install -qq --yes --no-install-recommends $missing > /dev/null
else
    echo "missing, and this user cannot install them:$missing. Tests that need them are skipped." >&2
fi
