"""The rules for a pension company: the law, and the terms of its pensions.

The law follows the Dutch financial assessment framework (FTK, in force from 2015), simplified:

- A premium covers the cost of the rights that it buys. A discount requires a coverage well above
  the required level (Pensions Act, articles 128 and 129; the discount of a fifth from 125 % on is
  our own round number).
- The *policy coverage*, by which a fund is judged, is the mean of the coverage over twelve months.
  Below 110 % there is no indexation. Above the level required in the long run (125 % here), a fund
  may make up for missed indexation (a fifth of it per year: our own number).
- The minimum is 104.3 %. A fund that is below it at six yearly measurements in a row has to cut
  rights. A fund that cannot recover within ten years without a cut has to cut at once; here, this
  applies below 90 %. Cuts may be spread over ten years.
- In a shortfall, a fund may not raise the risk of its assets. Below 100 %, it may not transfer
  values to other funds.

Sources: Pensioenfederatie, The Financial Assessment Framework; De Brauw, Pension funds with >90 %
cover ratio do not have to cut pensions (2019: the sixth measurement, 104.3 %); IPE, Implications of
FTK (2014: policy coverage), Dutch government considers extending pension fund recovery periods
(2016: ten years, the critical level of 90 to 95 %) and Funding drop blocks pension transfers
(2015). Not modelled: partners' pensions, tax, the state's pension, costs, the yield curve.
"""

from __future__ import annotations

from typing import Final

RETIREMENT: Final = 67 * 12  # the retirement age in months
LATEST_ENTRY: Final = 60 * 12  # the age in months from which candidates are no longer admitted
# the share of the yearly wage that a year of membership adds to the yearly pension
ACCRUAL: Final = 0.0175

# levels of coverage: the minimum, for indexation, required in the long run, critical, for transfers
MINIMUM, INDEXING, REQUIRED, CRITICAL, TRANSFERABLE = 1.043, 1.10, 1.25, 0.90, 1.0

# the yearly measurements in a row below the minimum that make a cut compulsory
MEASUREMENTS: Final = 6
SPREAD: Final = 10  # the number of years over which a cut is spread
HIGHEST_PREMIUM: Final = 0.35  # as a share of the wage
# contributions beyond the standard, as shares of it; the accrual grows alike
EXTRAS: Final = (0.0, 0.25, 0.5)
DISPOSABLE: Final = 0.3  # the share of a wage that remains after living expenses
