#!/bin/sh
# Runs the page's example of Mesa-LLM on the newest Python found, which must be 3.12 or newer. The model is in Mesa-LLM's source
# distribution alone.
set -eu
cd "$(dirname "$0")/.."
venv=$PWD/.venv-negotiation
version=0.3.2
quiet="--quiet --disable-pip-version-check"

for python in python3.13 python3.12 "$HOME"/.pyenv/versions/3.13.*/bin/python "$HOME"/.pyenv/versions/3.12.*/bin/python ""; do
    if "${python:-true}" -c "" 2> /dev/null; then break; fi
done
if test -z "$python"; then
    echo "no Python 3.12 or newer: Mesa-LLM is not tested" >&2
    exit
fi
test -x "$venv/bin/python" || "$python" -m venv "$venv"
"$venv/bin/python" --version
"$venv/bin/pip" install $quiet --editable . "mesa-llm==$version" openai

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"$venv/bin/pip" download $quiet --no-deps --no-binary mesa-llm --dest "$folder" "mesa-llm==$version"
tar -xzf "$folder"/*.tar.gz --strip-components 1 -C "$folder"
example=$PWD/docs/negotiation.py
cd "$folder"
LITELLM_LOCAL_MODEL_COST_MAP=True PYTHONPATH=. PYTHONWARNINGS=ignore "$venv/bin/python" "$example"
