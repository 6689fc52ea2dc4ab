"""The stability atlas as an analysis: solves at the nodes of its panels."""
