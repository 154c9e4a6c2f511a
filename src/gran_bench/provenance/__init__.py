"""Where a result comes from: command, commit, day, hardware, source."""

from gran_bench.provenance.origin import (
    command,
    commit,
    hardware,
    library_versions,
    program,
    provenance,
    read_table,
    remember_command,
    stamp,
    write_table,
)
