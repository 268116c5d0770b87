#!/bin/sh
# Fetches the locked packages for a robot without a network: deploy/wheelhouse.sh DIR [aarch64|x86_64] [3.11]
# Run it with the same Python version as the robot's; hashes are checked now and again when installing.
set -eu

[ $# -ge 1 ] || { echo "usage: deploy/wheelhouse.sh DIR [aarch64|x86_64] [PYTHON]" >&2; exit 2; }
target=$1
machine=${2:-$(uname -m)}
version=${3:-$(python3 -c 'import sys; print("%d.%d" % sys.version_info[:2])')}
locks=$(dirname "$(readlink -f -- "$0")")/../requirements.lock
python=$(command -v "python$version") || { echo "mapquilt: no python$version here; give the robot's version as third word, and install it here: uv python install $version" >&2; exit 3; }

set --
for platform in manylinux_2_28 manylinux_2_27 manylinux_2_26 manylinux_2_24 manylinux_2_17 manylinux2014 manylinux_2_12 manylinux_2_5; do
    set -- "$@" --platform "${platform}_$machine"
done
"$python" -m pip download --quiet --require-hashes --no-deps --only-binary :all: --implementation cp --abi "cp$(echo "$version" | tr -d .)" --abi abi3 --abi none \
    --python-version "$version" "$@" --dest "$target" -r "$locks"
echo "mapquilt: $(ls "$target"/*.whl | wc -l) packages for $machine, Python $version, in $target ($(du -sh "$target" | cut -f1)); on the robot: sudo deploy/install.sh --wheelhouse $target"
