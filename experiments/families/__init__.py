"""Which profile family has the least contact force in the same housing?

Writes families.csv (a row per design), families.json, families.png (the ranking),
families_profiles.png and overview.png (an example of every family), and prints the tables.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="one housing, two families",
    published={
        "families.png": "ranking.png",
        "families_profiles.png": "ranking_profiles.png",
        "overview.png": "families.png",
    },
    alone=True,
)
