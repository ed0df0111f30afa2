"""Philox4x32-10 against Random123's known answers, and the FMU's draws against both."""

from __future__ import annotations

import pytest

_MULTIPLIERS = 0xD2511F53, 0xCD9E8D57
_WEYL = 0x9E3779B9, 0xBB67AE85
_WORD = 0xFFFFFFFF


def philox(counter: list[int], key: list[int]) -> list[int]:
    """The algorithm as published, in Python integers."""
    x, k = list(counter), list(key)
    for _ in range(10):
        high, low = zip(
            *(divmod(m * x[2 * i], 1 << 32) for i, m in enumerate(_MULTIPLIERS)), strict=True
        )
        x = [high[1] ^ x[1] ^ k[0], low[1], high[0] ^ x[3] ^ k[1], low[0]]
        k = [(a + b) & _WORD for a, b in zip(k, _WEYL, strict=True)]
    return x


def uniforms(seed: int, sample: int) -> list[float]:
    """The four uniforms of a sample, in the order X1, F1, T1, T200."""
    key = [seed & _WORD, seed >> 32]
    k = sample % (1 << 64)
    words = [w for b in (0, 1) for w in philox([k & _WORD, k >> 32, b, 0], key)]
    pairs = zip(words[::2], words[1::2], strict=True)
    return [((high >> 5) * 2**26 + (low >> 6)) / 2**53 for high, low in pairs]


# Random123 1.14, examples/kat_vectors
@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    [
        ("00000000 00000000 00000000 00000000", "00000000 00000000",
         "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff",
         "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0",
         "d16cfe09 94fdcceb 5001e420 24126ea1"),
    ],
)  # fmt: skip
def test_python_port_gives_the_known_answers(counter: str, key: str, answer: str) -> None:
    def parse(text: str) -> list[int]:
        return [int(word, 16) for word in text.split()]

    assert philox(parse(counter), parse(key)) == parse(answer)


@pytest.mark.parametrize("sample", [0, 1, 7, 2**31, 2**32 + 5, 2**33, -1, -10])
def test_draws_are_philox_of_seed_and_sample(plant, sample: int) -> None:
    plant.initialise(start=60.0 * sample, seed=12345)
    expected = [
        nominal + half_width * (2 * u - 1)
        for nominal, half_width, u in zip(
            (5, 10, 40, 25), (1, 2, 8, 5), uniforms(12345, sample), strict=True
        )
    ]
    assert plant.get("X1", "F1", "T1", "T200") == expected


def test_both_halves_of_the_seed_are_the_key(open_fmu) -> None:
    seed = 0xFEDCBA9876543210
    low, high = (int.from_bytes(seed.to_bytes(8, "little")[i : i + 4], "little", signed=True)
                 for i in (0, 4))  # fmt: skip
    two = open_fmu(2).initialise(seed=low, seedHigh=high)
    three = open_fmu(3).initialise(seed=seed)
    expected = 5.0 + (2 * uniforms(seed, 0)[0] - 1)
    assert two.get("X1") == three.get("X1") == [expected]
    assert two.get("seed", "seedHigh") == [low, high]
    assert three.get("seed") == [seed]
