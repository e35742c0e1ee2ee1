"""Numbers, rates and sizes as text."""
import pytest

from pharos.live import figures


@pytest.mark.parametrize(
    'function, texts',
    [
        (
            figures.number_text,
            {0: '0', 0.00001: '0.000010', 0.25: '0.25', 99.96: '100', 1e6: '1000000'},
        ),
        (figures.rate_text, {9.913: '9.91 Hz', 30: '30 Hz', 1234.5: '1234 Hz'}),
        (figures.size_text, {999: '999 B', 999.6: '1 kB', 6220800: '6.22 MB', 2e12: '2000 GB'}),
        (figures.short_number, {0: '0', 999: '999', 1200: '1.2k', 35e6: '35M', 4.3e9: '4.3G'}),
        (figures.short_rate, {0.25: '0.2', 29.83: '29.8', 99.96: '100', 1200: '1.2k'}),
    ],
)
def test_numbers_are_told_in_few_characters(function, texts):
    assert {value: function(value) for value in texts} == texts
