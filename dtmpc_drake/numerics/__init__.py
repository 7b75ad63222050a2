"""Arrays, filters, splines and polynomials: no word of the method may enter here."""
