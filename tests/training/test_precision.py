import pytest
import torch

from coachable.training.precision import resolve_precision, supports_bf16


def test_auto_is_bf16_where_the_hardware_has_it(monkeypatch):
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: True)
    for flags, expected in (({"avx512_bf16": True}, "bf16"), ({"amx_bf16": True}, "bf16"), ({"avx2": True}, "fp32")):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda flags=flags: flags)
        assert resolve_precision("auto", "cpu") == expected
        assert supports_bf16("cpu") is (expected == "bf16")


def test_explicit_precision_is_taken_literally():
    assert resolve_precision("bf16", "cpu") == "bf16"
    assert resolve_precision("fp32", "cpu") == "fp32"
    with pytest.raises(ValueError, match="precision"):
        resolve_precision("fp16")
    assert not supports_bf16("meta")
