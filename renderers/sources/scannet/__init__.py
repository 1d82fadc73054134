"""PS15 from ScanNet's scans and Scan2CAD's alignments; docs/ps15.md gives conventions and rules."""
