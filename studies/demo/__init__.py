"""Pictures of the results of ``make demo`` and ``make plan``."""
