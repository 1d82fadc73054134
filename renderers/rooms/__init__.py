"""Simulated rooms, scanned and annotated, in ScanNet's and Scan2CAD's own file formats."""
