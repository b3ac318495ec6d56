"""What does a twist of the rotors change, for two to four lobes?

Writes twist.csv (a row per twist and number of lobes) and twist.png.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="three lobes, two twists, two slices", published={"twist.png": "twist.png"}, cache=False
)
