"""The firmware fits both processors, and opens as an Arduino sketch."""

import re
import subprocess

import pytest

from sim.board import BUILD_DIR, FIRMWARE_DIR, MCUS

# bytes of flash and of RAM on the chip; of the RAM 700 bytes are left to the stack
CHIPS = {"atmega2560": (256 * 1024, 8192), "atmega328p": (32 * 1024, 2048)}
STACK_BYTES = 700


@pytest.mark.avr
@pytest.mark.usefixtures("avr_tools")
@pytest.mark.parametrize("mcu", MCUS)
def test_fits(mcu: str) -> None:
    elf = BUILD_DIR / f"seldinger-{mcu}.elf"
    sizes = subprocess.run(["avr-size", str(elf)], capture_output=True, text=True, check=True).stdout.splitlines()[1]
    text, data, bss = (int(word) for word in sizes.split()[:3])
    flash, ram = CHIPS[mcu]
    assert text + data < flash // 3
    assert data + bss + STACK_BYTES < ram


def test_opens_as_a_sketch() -> None:
    """The folder's name is the sketch's, everything else is in src/, and only the sketch has setup() and loop()."""
    sketch = FIRMWARE_DIR / f"{FIRMWARE_DIR.name}.ino"
    text = sketch.read_text()
    assert re.search(r"void setup\(\)", text) and re.search(r"void loop\(\)", text)
    assert not list(FIRMWARE_DIR.glob("*.c")) and not list(FIRMWARE_DIR.glob("*.h"))
    included = set(re.findall(r'#include "src/(\w+\.h)"', text))
    assert included and all((FIRMWARE_DIR / "src" / name).exists() for name in included)


def test_the_core_is_free_of_hardware() -> None:
    """Only the AVR layer, and the port's critical sections, know the processor."""
    for source in (FIRMWARE_DIR / "src").iterdir():
        if source.name not in ("avr_main.c", "port.h"):
            assert "#include <avr/" not in source.read_text(), source.name
