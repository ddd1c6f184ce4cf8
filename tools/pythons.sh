#!/bin/sh
# Tests with each Python that is named and found, on the PATH or kept by pyenv. Those that are not found are told of.
#   sh tools/pythons.sh "packages" "tests" 3.12 3.13
set -eu
packages=$1 tests=$2
shift 2

for version; do
    python=$(sh tools/python.sh "$version")
    if [ "$python" = python3 ]; then
        echo "Python $version is not found; it is not tested." >&2
        continue
    fi
    echo "Python $version: $python"
    folder=.venv-$version
    if [ ! -e "$folder/.installed" ] || [ pyproject.toml -nt "$folder/.installed" ]; then
        test -x "$folder/bin/python" || "$python" -m venv "$folder"
        # shellcheck disable=SC2086
        "$folder/bin/pip" install --quiet --disable-pip-version-check --editable '.[many]' $packages
        touch "$folder/.installed"
    fi
    # shellcheck disable=SC2086
    "$folder/bin/python" -m pytest --quiet -n 2 --driver greenlet $tests
done
