"""A data folder in the formats of other libraries: Parquet, WebDataset, BOP."""

from partialbench.dataset.export.run import TARGETS, check_export, export, is_export

__all__ = ["TARGETS", "check_export", "export", "is_export"]
