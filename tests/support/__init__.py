"""What several tests share: scenes, rigs, fake devices, graphs."""

import pytest

# Their assertions then say what differs, as those of test modules do.
pytest.register_assert_rewrite("support.match_scripts", "support.tiny_graph")
