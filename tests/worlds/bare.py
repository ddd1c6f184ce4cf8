"""A simulator that sends only required frames, and other text: ``python bare.py POINT ...``.

It has six decisions in an episode, the third and the sixth at its last point, the others at its
first.
"""

import json
import os
import sys


def main():
    """Play one episode after the other."""
    reading, writing = map(int, os.environ["SIMENV_MARL_FDS"].split(","))
    with open(reading) as lines, open(writing, "w", buffering=1) as out:
        out.write(json.dumps({"hello": 1, "points": sys.argv[1:], "written in": "Python"}) + "\n")
        for _ in lines:
            values = []
            for number in range(1, 7):
                point = sys.argv[-1 if number % 3 == 0 else 1]
                out.write(json.dumps({"decide": number, "point": point, "aside": [number]}) + "\n")
                answer = json.loads(next(lines))
                if "stop" in answer:
                    break
                values.append(answer.get("value"))
            else:
                out.write(json.dumps({"end": {"result": values}}) + "\n")


if __name__ == "__main__":
    main()
