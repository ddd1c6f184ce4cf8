"""Planning in models that are driven by events, beside their rules."""
