"""The experiments of the thesis's chapter 4, on the UMCD dataset or on a simulated one (`sorvolo reproduce`)."""
