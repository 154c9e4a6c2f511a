"""The data: cases as HDF5 files that are made once, checked when read, and split into what trains and what judges."""

from gran_bench.dataset.case_file import Case, read_attributes, read_case, read_settled
from gran_bench.dataset.case_spec import (
    CaseSpec,
    DatasetError,
    Split,
    half_step,
    has_splits,
    own_case,
    replicas,
    rotation_label,
)
from gran_bench.dataset.ensure import ensure_beds, ensure_case, ensure_cases
from gran_bench.dataset.imported import case_at, imported_replicas, split_cases
from gran_bench.dataset.scene_document import from_document, to_document
from gran_bench.dataset.summary import generate
from gran_bench.dataset.windows import Window, Windows, dataset_digest
