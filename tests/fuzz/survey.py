"""Count what becomes of spoiled calls of every public name, and list what may not be.

    python -m tests.fuzz.survey 10000 --seed 1

`--each` puts every value of a list in the place of every argument instead. `--only`
asks for calls whose name holds a text. Every find is a line of JSON in `--output`;
finds of one place are printed once.
"""

import argparse
import collections
import json
import re
import resource
import time

import matplotlib
from hypothesis import HealthCheck, Phase, given, seed, settings

from .calls import calls, shares
from .hostile import VALUES, WORDS, spoiled
from .outcomes import GOOD, outcome_of_spoiled

BYTES = 8 << 30  # of memory: a call that asks for more fails, and this machine does not


def survey(name, n_cases, start):
    """The name, the outcome and the spoiled arguments of every case of a call."""
    call, cases = calls()[name], []

    @seed(start)
    @settings(
        max_examples=n_cases,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(spoiled(call.arguments))
    def spoil(arguments):
        found = outcome_of_spoiled(call, arguments)
        told = {k: f"{v!r:.200} <{type(v).__name__}>" for k, v in arguments.items()}
        cases.append((name, found, told))

    spoil()
    return cases


def sweep(name):
    """As `survey`, of every listed value in the place of every argument."""
    call, cases = calls()[name], []
    for argument, valid in call.arguments.items():
        for value in (*VALUES, *WORDS) if isinstance(valid, str) else VALUES:
            found = outcome_of_spoiled(call, {argument: value})
            told = {argument: f"{value!r:.200} <{type(value).__name__}>"}
            cases.append((name, found, told))
    return cases


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", type=int, nargs="?", default=10_000)
    parser.add_argument("--each", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    parser.add_argument("--output", default=None)
    asked = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
    matplotlib.use("Agg")
    start = time.process_time()
    cases = []
    for name, number in shares(asked.cases).items():
        if number and asked.only in name:
            cases += sweep(name) if asked.each else survey(name, number, asked.seed)
    counts = collections.Counter(found.kind for _, found, _ in cases)
    print(f"{len(cases)} cases in {time.process_time() - start:.0f} s of CPU:")
    for kind, count in counts.most_common():
        print(f"{count:8d}  {kind}")
    bad = [case for case in cases if case[1].kind not in GOOD]
    places = collections.defaultdict(list)
    for name, found, told in bad:
        place = re.sub(r"[0-9.e+-]{3,}", "#", found.detail.split(" @ ")[-1])
        places[found.kind, place].append((name, found.detail, told))
    for (kind, place), finds in sorted(places.items()):
        name, detail, told = finds[0]
        print(f"\n{kind} x{len(finds)} {name} {told}\n    {detail}\n    {place}")
    if asked.output:
        with open(asked.output, "w") as file:
            for name, found, told in bad:
                file.write(json.dumps([name, *found, told]) + "\n")


if __name__ == "__main__":
    main()
