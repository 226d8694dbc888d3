"""The machine under diagnosis: case, protocol, candidate effects."""
