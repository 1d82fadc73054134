"""The board as one web page: what it says (``content``), its clouds, and the file (``html``)."""
