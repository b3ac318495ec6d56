"""Do the prices of limits agree with optima found again with each limit moved?

Writes prices.csv, prices.json and prices.png. The exit code is 3 if a price differs by more than
2 %, or if a search ends without a certificate.
"""

from experiments._common.driver import Study

STUDY = Study(quick="one limit of one case, one start")
