"""What a network is trained on, and in which precision."""

from __future__ import annotations

import torch


def best_device() -> torch.device:
    """CUDA where there is one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def has_bf16(device: torch.device) -> bool:
    """Whether the device multiplies in bfloat16 itself; where it only imitates that, float32 is faster and better."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    able = torch.cpu.get_capabilities()
    return bool(able.get("amx_bf16") or able.get("avx512_bf16"))


def autocast(device: torch.device) -> torch.autocast:
    """A context in which networks compute in bfloat16 on a device that has it, and as they are elsewhere."""
    return torch.autocast(device.type, torch.bfloat16, enabled=has_bf16(device))


def described(device: torch.device) -> str:
    """The device and the precision, for people."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    return f"{name}, {'bfloat16' if has_bf16(device) else 'float32'}"
