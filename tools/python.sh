#!/bin/sh
# Prints the first Python that is found of the versions that are named, on the PATH or kept by pyenv; else python3.
#   sh tools/python.sh 3.14 3.13
for version; do
    for found in "python$version" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$version".*/bin/python; do
        # A shim of pyenv is on the PATH also where its Python is not active.
        "$found" -c "import venv" 2> /dev/null && echo "$found" && exit
    done
done
echo python3
