"""Files of weights: what is damaged is refused by name, and a full disk loses nothing that was there before."""

from __future__ import annotations

import pytest
import torch

from gran_bench.surrogate.checkpoint import CheckpointError, ModelCard, load_card, read_tensors, save_model

CARD = ModelCard({"name": "contact"}, {}, {}, {})


def weights(value: float) -> dict[str, torch.Tensor]:
    return {"layer": torch.full((1000,), value)}


def test_every_flipped_bit_of_the_weights_is_noticed(tmp_path):
    path = tmp_path / "model.pt"
    save_model(path, weights(1.0), CARD)
    content = path.read_bytes()
    first = content.index(weights(1.0)["layer"].numpy().tobytes())
    for place in range(first, first + 4000, 97):
        path.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        with pytest.raises(CheckpointError, match=r"model\.pt is not a whole gran-bench model file .*checksum"):
            load_card(path)


def test_a_file_that_was_cut_short_is_refused_by_name(tmp_path):
    path = tmp_path / "model.pt"
    save_model(path, weights(1.0), CARD)
    content = path.read_bytes()
    for length in (0, 3, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(CheckpointError, match=r"model\.pt is not a whole gran-bench model file .* train it again"):
            load_card(path)


@pytest.mark.parametrize("room", [0, 1000, 4000])
def test_a_full_disk_names_file_and_remedy_and_keeps_the_older_file(full_at, tmp_path, room):
    path = tmp_path / "model.pt"
    save_model(path, weights(1.0), CARD)
    with full_at(room), pytest.raises(CheckpointError, match=r"model\.pt cannot be written .*; free space"):
        save_model(path, weights(2.0), CARD)
    assert torch.equal(read_tensors(path)["weights"]["layer"], weights(1.0)["layer"])
    assert [entry.name for entry in tmp_path.iterdir()] == ["model.pt"]
