"""Many faults, by hand: ``python -m tests.faults [--rounds 300] [--seed 0] [--only shac mpc] [--folder PATH]``."""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from collections import Counter
from pathlib import Path

from .bench import FULL, SIGNALS, Bench, can_mount, draw_strike
from .cases import CASES
from .damage import DAMAGES
from .server import serving

KINDS = ("strike", "full", "damage")


def parse(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=list(CASES), choices=list(CASES), metavar="RECIPE")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=KINDS)
    parser.add_argument("--folder", type=Path, default=None, help="where what failed stays")
    return parser.parse_args(words)


def main() -> int:
    given = parse(sys.argv[1:])
    folder = given.folder or Path(tempfile.mkdtemp(prefix="faults"))
    folder.mkdir(parents=True, exist_ok=True)
    done: Counter[tuple[str, str]] = Counter()
    failed = 0
    with serving() as server:
        bench, mounts = Bench(server, folder), can_mount(folder)
        for index in range(given.rounds):
            draw = random.Random(f"{given.seed} {index}")
            name, kind = given.only[index % len(given.only)], draw.choice(given.kinds)
            whole = bench.whole(name)
            if kind == "damage":
                file, how = draw.choice(whole.files), draw.choice(list(DAMAGES))
                outcome, wrong = bench.damaged(name, file, how, draw)
                what = f"{file} {how}: {outcome}"
                done[f"{file.suffix} {outcome}", "damaged"] += 1
            elif kind == "full" and mounts and draw.random() < 0.5:
                share = draw.random()
                what, wrong = f"{FULL} at {share:.2f}", bench.fill(name, share)
                done[name, "full disk"] += 1
            else:
                kinds = [FULL if kind == "full" else draw.choice(SIGNALS) for _ in range(draw.choice((1, 1, 2)))]
                strikes = [draw_strike(draw, whole, each) for each in kinds]
                what, wrong = ", ".join(map(str, strikes)), bench.strike(name, strikes)
                for each in kinds:
                    done[name, each if isinstance(each, str) else each.name] += 1
            failed += bool(wrong)
            sys.stdout.write(f"{index:4} {name}: {what}: {'; '.join(wrong) or 'well'}\n")
            sys.stdout.flush()
    for (name, kind), count in sorted(done.items()):
        sys.stdout.write(f"{name:20} {kind:10} {count}\n")
    sys.stdout.write(f"{failed} of {given.rounds} failed; folder {folder}\n")
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main())
