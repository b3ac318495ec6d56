"""Which scene gives the paper's contact forces, and how far do they determine it?

Writes paper.csv, paper_motions.csv, paper_definitions.csv, paper_slices.csv, paper_profile.csv,
paper.json, paper_force.png, paper_spectrum.png and paper_uniqueness.png. With --search, it searches
for further scenes by `identify` instead, and writes paper_search.json. The exit code is then 3 if
no such scene is found. Results: docs/paper.md.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="linear contact, each quantity changed twice; one local fit of a search",
    published={
        f"paper_{name}.png": f"paper_{name}.png" for name in ("force", "spectrum", "uniqueness")
    },
    options={
        "--search": {"action": "store_true", "help": "search for other values"},
        "--seed": {"type": int, "default": 0, "help": "seed of the search (default: 0)"},
        "--least-clearance": {
            "type": float,
            "metavar": "MM",
            "help": "smallest clearance searched",
        },
    },
    further=(("--search",),),
)
