"""What does a free form gain over the best CIC, and where does it depart from it?

Writes freeform.json, freeform.yaml (the config with the optimised design) and freeform.png.
"""

from experiments._common.driver import Study

STUDY = Study(quick="a few steps", published={"freeform.png": "freeform.png"})
