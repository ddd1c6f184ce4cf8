"""What a pension company must and may do: the law, and what is agreed with its clients.

The law follows the Dutch financial assessment framework (FTK, in force from 2015), simplified:

- A premium covers the cost of the rights that it buys. A discount takes a coverage well above the required one
  (Pensions Act, articles 128 and 129; the discount of a fifth from 125 % on is our own round number).
- The *policy coverage*, by which a fund is judged, is the mean of the coverage over twelve months. Below 110 % there is
  no indexation. Above the level required in the long run (125 % here), missed indexation may be repaired (by a fifth a
  year: our number).
- The minimum is 104.3 %. A fund that is below it at six yearly measurements in a row has to cut rights. A fund that
  cannot recover within ten years otherwise has to cut at once; 90 % stands for that here. Cuts may be spread over ten
  years.
- In a shortfall, a fund may not raise the risk of its assets. Below 100 %, it may not transfer values to other funds.

Sources: Pensioenfederatie, The Financial Assessment Framework; De Brauw, Pension funds with >90 % cover ratio do not
have to cut pensions (2019: the sixth measurement, 104.3 %); IPE, Implications of FTK (2014: policy coverage), Dutch
government considers extending pension fund recovery periods (2016: ten years, the critical level of 90 to 95 %) and
Funding drop blocks pension transfers (2015). Not modelled: partners' pensions, tax, the state's pension, costs, the
yield curve.
"""

from __future__ import annotations

from typing import Final

RETIREMENT: Final = 67 * 12
"""Age in months from which pensions are paid."""

LATEST_ENTRY: Final = 60 * 12
"""Age in months from which no candidate is admitted."""

ACCRUAL: Final = 0.0175
"""The share of a yearly wage that a year of membership adds to the yearly pension."""

MINIMUM, INDEXING, REQUIRED, CRITICAL, TRANSFERABLE = 1.043, 1.10, 1.25, 0.90, 1.0
"""Coverage: the minimum, that of indexation, that required in the long run, the critical one, that of transfers."""

MEASUREMENTS: Final = 6
"""How many yearly measurements below the minimum in a row make a cut compulsory."""

SPREAD: Final = 10
"""Over how many years a cut is spread."""

HIGHEST_PREMIUM: Final = 0.35
"""The share of a wage that a client can be asked to pay."""

EXTRAS: Final = (0.0, 0.25, 0.5)
"""How much more than the standard a client can pay and accrue."""

DISPOSABLE: Final = 0.3
"""The share of a wage that is not spent on living."""
