"""One module per format, and modules that several formats share. A new format is imported here, and nowhere else."""

from .csv_tables import CsvFile, CsvImporter, import_csv
from .hdf5_files import Hdf5Importer
from .mat_files import MatImporter
from .npz_files import NpzImporter
from .parquet_files import ParquetImporter
from .ros_bags import McapImporter

__all__ = [
    "CsvFile",
    "CsvImporter",
    "Hdf5Importer",
    "MatImporter",
    "McapImporter",
    "NpzImporter",
    "ParquetImporter",
    "import_csv",
]
