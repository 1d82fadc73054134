"""Simulated scanned rooms, written in the file formats of ScanNet and Scan2CAD."""
