//! Names of the kernels in `kernels/`.

/// Hands the list of kernels, as this program and as their source name them, to a macro.
macro_rules! each_kernel {
    ($with:ident) => {
        $with! {
            NormForward norm_forward, NormBackward norm_backward, NormParameters norm_parameters,
            ColumnSums column_sums, SumPartials sum_partials, CellForward cell_forward, CellBackward cell_backward,
            Draw draw, DrawBackward draw_backward, BalancedKl balanced_kl,
            FillRows fill_rows, CopyRows copy_rows, GatherRows gather_rows, Zero zero, Tanh tanh_of,
            Carry carry, CarryBackward carry_backward, Transpose transpose, SumOf sum_of, Noise noise,
            InteractionForward interaction_forward, InteractionBackward interaction_backward,
            Windows windows, FromWindows from_windows, GatherImages gather_images, GatherSeen gather_seen, PictureLoss picture_loss,
            TwoHotLoss two_hot_loss, TwoHotMean two_hot_mean, ContinueLoss continue_loss, ScaledSigmoid scaled_sigmoid,
            ActorDraw actor_draw, ActorBackward actor_backward, CloningLoss cloning_loss, LambdaReturns lambda_returns, ActorLoss actor_loss,
            ReturnRange return_range, Squares squares, Clip clip, Adam adam, Mix mix,
            NarrowForward narrow_forward, NarrowBackward narrow_backward,
            ProductFewRows product_few_rows, ProductFewRowsBack product_few_rows_back,
        }
    };
}
pub(crate) use each_kernel;

macro_rules! define {
    ($($variant:ident $name:ident),* $(,)?) => {
        /// A kernel of `kernels/`.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum Kernel { $($variant),* }

        impl Kernel {
            /// All of them.
            pub const ALL: &[Self] = &[$(Self::$variant),*];

            /// Its name in the source.
            #[must_use]
            pub fn name(self) -> &'static str {
                match self { $(Self::$variant => stringify!($name)),* }
            }
        }
    };
}

each_kernel!(define);
