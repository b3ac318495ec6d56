"""What can be optimised where the motion is chaotic?

Writes chaos_line.csv, chaos_pathwise.csv, chaos_history.csv, chaos_members.csv,
chaos_gradients.csv, chaos.json and chaos.png.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="few members, short windows, one descent step", published={"chaos.png": "chaos.png"}
)
