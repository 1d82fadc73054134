"""PAPNet, its ablations and its corrected successor."""
