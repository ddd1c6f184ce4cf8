#!/bin/sh
# Builds the wheel, installs it, and creates each template in an empty folder and runs its tests. Uses the first Python that
# is found of those that are named, and the newest Mesa for it, whose example models are tested as well.
#   sh tools/templates.sh 3.14 3.13
set -eu
cd "$(dirname "$0")/.."
venv=$PWD/.venv-templates
quiet="--quiet --disable-pip-version-check"

python=$(sh tools/python.sh "$@")
venv=$venv-$("$python" -c 'import sys; print(sys.version_info.minor)')
test -x "$venv/bin/python" || "$python" -m venv "$venv"
"$venv/bin/python" --version

rm -rf "$venv/dist"
"$venv/bin/pip" wheel $quiet --no-deps --wheel-dir "$venv/dist" .
wheel=$(echo "$venv"/dist/*.whl)
"$venv/bin/pip" install $quiet "$wheel[experiments]" pytest hypothesis simpy cma "mesa[network]"
"$venv/bin/pip" install $quiet --force-reinstall --no-deps "$wheel" # the same version, but a new build

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for kind in plain simpy mesa; do
    (
        cd "$folder"
        "$venv/bin/python" -m simenv_marl new $kind "my_$kind"
        cd "my_$kind"
        "$venv/bin/python" -m pytest -q
        # the plain template trains with Stable-Baselines3: see tests/clients/test_templates.py
        test $kind = plain || "$venv/bin/python" -m "my_$kind" --quick
    )
done
"$venv/bin/python" -m pytest -q tests/examples/test_mesa_models.py tests/contract/test_mesa.py
