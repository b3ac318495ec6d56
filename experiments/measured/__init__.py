"""How do form errors of a measured rotor change the gap in rolling and the contact force?

Writes measured.csv (the points), measured.json and measured.png.
"""

from experiments._common.driver import Study

STUDY = Study(quick="no simulations", published={"measured.png": "outline.png"}, cache=False)
