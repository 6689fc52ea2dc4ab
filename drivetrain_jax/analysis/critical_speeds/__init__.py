"""Critical speeds of stepped shafts: transfer matrices, certified roots, mode shapes."""
