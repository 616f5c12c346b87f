"""What all formats share."""

import pytest

from heatsplat.export.formats.base import optional


def test_a_missing_package_names_the_extra():
    with pytest.raises(ImportError, match=r"what=las needs nopackage: pip install 'heatsplat\[export\]'"):
        optional("nopackage.inner", "las")
