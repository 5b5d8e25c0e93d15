"""A predictor that needs no weights: a hierarchical spherical plane sweep."""
